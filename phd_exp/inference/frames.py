"""The frames of a video file or a recording, and of the user's own images with times."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from phd_exp.data.crops import read_image
from phd_exp.fusion import Pose
from phd_exp.inference.following import HERE, Frame
from phd_exp.optics.virtual import Box
from phd_exp.records.detections import Detection
from phd_exp.records.errors import DatasetError
from phd_exp.records.images import pillow_warnings
from phd_exp.records.messages import SECOND
from phd_exp.records.recordings import Recording
from phd_exp.records.videos import Shot


def video_frames(
    detection: Detection, boxes: Mapping[int, Sequence[Box]] | None, shots: Iterable[Shot]
) -> Iterator[Frame]:
    """The frames of a video or a recording; None for `boxes` means whole images.

    Raises DatasetError if the camera or a box is not valid, and all errors of the shots.
    """
    first: Frame | None = None
    for shot in shots:
        where = f"{detection.file}, frame {shot.number}"
        given = None if boxes is None else _boxes(detection, boxes.get(shot.number, ()), shot.image, where)
        first = first or frame_of(detection, shot.image, shot.time, None)
        yield replace(first, time=shot.time, image=shot.image, boxes=given, where=where)


def recorded_shots(recording: Recording, stride: int = 1) -> Iterator[Shot]:
    """Every `stride`-th image of a recording, with its time after the first one.

    Raises DatasetError, after the images before, if one cannot be read, has another size, or a time that is not later
    than that of the one before.
    """
    size, before = None, recording.start - 1
    for number, detection in enumerate(recording):
        image = detection.recorded
        assert image is not None
        if image.time <= before:
            apart = (before - image.time) / SECOND
            raise DatasetError(
                f"{detection.where}: time: {apart:g} s before the image before; expected increasing times in the "
                "headers; cut the recording there"
            )
        before = image.time
        if number % stride == 0:
            with pillow_warnings():
                pixels = np.asarray(read_image(detection.file, image.content))
            size = _alike(detection.where, pixels, size)
            yield Shot(number, (image.time - recording.start) / SECOND, pixels)


def folder_frames(detections: Sequence[Detection], has_boxes: bool = False) -> Iterator[Frame]:
    """The frames of one track; without any box, whole images unless `has_boxes`.

    Raises DatasetError if a time, pose, image or camera is missing or invalid.
    """
    has_poses = any(detection.line.pose for detection in detections)
    has_boxes = has_boxes or any(detection.line.box for detection in detections)
    before, size = -np.inf, None
    for detection in detections:
        where, line = detection.where, detection.line
        if line.time is None:
            raise DatasetError(f"{where}: time is missing; expected the time of the image, seconds")
        if not line.time > before:
            raise DatasetError(f"{where}: time: got {line.time:g} after {before:g}; expected increasing times")
        if has_poses and line.pose is None:
            raise DatasetError(f"{where}: pose is missing; expected one on all lines of the track, or on none")
        with pillow_warnings():
            image = np.asarray(read_image(detection.file, detection.content))
        size = _alike(where, image, size)
        before = line.time
        boxes = _boxes(detection, [line.box] if line.box else [], image, where) if has_boxes else None
        yield frame_of(detection, image, line.time, boxes)


def _alike(where: str, image: np.ndarray, size: tuple[int, ...] | None) -> tuple[int, ...]:
    """The shape of an image. Raises DatasetError if it is not that of the first one."""
    if size and image.shape != size:
        got, expected = (f"{shape[1]} x {shape[0]}" for shape in (image.shape, size))
        raise DatasetError(f"{where}: got {got} pixels; expected {expected} as in the first frame of the track")
    return image.shape


def frame_of(detection: Detection, image: np.ndarray, time: float, boxes: tuple[Box, ...] | None) -> Frame:
    """A frame with the camera of a detection. Raises DatasetError if it is not that of this image."""
    height, width = image.shape[:2]
    K, lens = detection.optics(width, height)
    pose = HERE
    if detection.line.pose:
        poses = Pose.from_scene([detection.line.pose])
        pose = Pose(poses.R[0], poses.t[0])
    return Frame(time, image, K, boxes, pose, lens, detection.where)


def _boxes(detection: Detection, boxes: Sequence[Box], image: np.ndarray, where: str) -> tuple[Box, ...]:
    """The boxes, checked."""
    height, width = image.shape[:2]
    lines = [detection.line.model_copy(update={"box": box}) for box in boxes]
    return tuple(replace(detection, line=line, where=where).box(width, height) for line in lines)

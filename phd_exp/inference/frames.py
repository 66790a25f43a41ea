"""The frames of a video file, and of the user's own images with times."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from phd_exp.data.crops import read_image
from phd_exp.fusion import Pose
from phd_exp.inference.following import HERE, Frame
from phd_exp.optics.lens import PINHOLE
from phd_exp.optics.virtual import Box, intrinsics, require_no_fold
from phd_exp.records.detections import Detection
from phd_exp.records.errors import DatasetError
from phd_exp.records.images import content_of, pillow_warnings
from phd_exp.records.videos import shots_in


def video_frames(detection: Detection, boxes: Mapping[int, Sequence[Box]] | None, stride: int = 1) -> Iterator[Frame]:
    """Every `stride`-th frame of a video; None for `boxes` means whole images.

    Raises DatasetError if the video, the camera or a box is not valid.
    """
    first: Frame | None = None
    for shot in shots_in(detection.file, stride):
        where = f"{detection.file}, frame {shot.number}"
        given = None if boxes is None else _boxes(detection, boxes.get(shot.number, ()), shot.image, where)
        first = first or frame_of(detection, shot.image, shot.time, None)
        yield replace(first, time=shot.time, image=shot.image, boxes=given, where=where)


def folder_frames(detections: Sequence[Detection]) -> Iterator[Frame]:
    """The frames of one track. Raises DatasetError if a time, pose, image or camera is missing or invalid."""
    has_poses = any(detection.line.pose for detection in detections)
    has_boxes = any(detection.line.box for detection in detections)
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
            image = np.asarray(read_image(detection.file, content_of(detection.file)))
        size = size or image.shape
        if image.shape != size:
            got, expected = (f"{shape[1]} x {shape[0]}" for shape in (image.shape, size))
            raise DatasetError(f"{where}: got {got} pixels; expected {expected} as in the first frame of the track")
        before = line.time
        boxes = _boxes(detection, [line.box] if line.box else [], image, where) if has_boxes else None
        yield frame_of(detection, image, line.time, boxes)


def frame_of(detection: Detection, image: np.ndarray, time: float, boxes: tuple[Box, ...] | None) -> Frame:
    """A frame with the camera of a detection. Raises DatasetError if it is not that of this image."""
    height, width = image.shape[:2]
    K = intrinsics(*detection.focal_lengths_and_centre(width, height))
    lens = detection.calibration.lens if detection.calibration else PINHOLE
    try:
        require_no_fold(K, lens, width, height)
    except ValueError as error:
        raise DatasetError(f"{detection.where}: {error}") from None
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

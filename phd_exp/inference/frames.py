"""The frames of a path: of a folder of images, a video file, or a recording, one after the other."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from phd_exp.data.crops import read_image
from phd_exp.fusion import Pose
from phd_exp.inference.following import HERE, Frame
from phd_exp.optics.virtual import Box
from phd_exp.records.detections import Detection
from phd_exp.records.errors import DatasetError
from phd_exp.records.images import pillow_warnings
from phd_exp.records.messages import SECOND
from phd_exp.records.recordings import Recording
from phd_exp.records.videos import shots_in

Boxes = Mapping[int, Sequence[Box]] | None
"""The boxes of each frame by its number; None for predictions from whole images."""
Shown = tuple[Detection, UInt8[np.ndarray, "height width 3"], Sequence[Box] | None]
"""The camera, the time and the place of a frame, its pixels, and its boxes; None for the whole image."""


def of_folder(detections: Sequence[Detection], has_boxes: bool = False) -> Iterator[Frame]:
    """The frames of one track; without any box, whole images unless `has_boxes`. Raises DatasetError as `_frames`."""
    has_poses = any(detection.line.pose for detection in detections)
    has_boxes = has_boxes or any(detection.line.box for detection in detections)

    def shown() -> Iterator[Shown]:
        for one in detections:
            if has_poses and one.line.pose is None:
                raise DatasetError(
                    f"{one.where}: pose is missing; expected one on all lines of the track, or on none"
                )
            yield one, _pixels(one), ([one.line.box] if one.line.box else []) if has_boxes else None

    return _frames(shown())


def of_video(file: Path, camera: Detection, boxes: Boxes, stride: int = 1) -> Iterator[Frame]:
    """Every `stride`-th frame of a video with the camera of a detection. Raises as `_frames` and `shots_in`."""
    for_each = (
        (_at(camera, shot.time, f"{file}, frame {shot.number}"), shot.image, _of(boxes, shot.number))
        for shot in shots_in(file, stride)
    )
    return _frames(for_each)


def of_recording(recording: Recording, boxes: Boxes, stride: int = 1) -> Iterator[Frame]:
    """Every `stride`-th image of a recording, with its time after the first one. Raises DatasetError as `_frames`."""

    def shown() -> Iterator[Shown]:
        for number, one in enumerate(recording):
            if number % stride == 0:
                assert one.recorded is not None
                time = (one.recorded.time - recording.start) / SECOND
                yield _at(one, time, one.where), _pixels(one), _of(boxes, number)

    return _frames(shown())


def _frames(shown: Iterable[Shown]) -> Iterator[Frame]:
    """The frames of one path.

    Raises DatasetError if a time is missing or not later than the one before, or an image, its size, a box or a
    camera is invalid.
    """
    before, size = -np.inf, None
    for detection, image, boxes in shown:
        where, line, (height, width) = detection.where, detection.line, image.shape[:2]
        if line.time is None:
            raise DatasetError(f"{where}: time is missing; expected the time of the image, seconds")
        if not line.time > before:
            raise DatasetError(f"{where}: time: got {line.time:g} after {before:g}; expected increasing times")
        size, before = size or (width, height), line.time
        if (width, height) != size:
            expected = f"{size[0]} x {size[1]} as in the first frame of the track"
            raise DatasetError(f"{where}: got {width} x {height} pixels; expected {expected}")
        K, lens = detection.optics(*size)
        checked = [
            replace(detection, line=line.model_copy(update={"box": box})).box(width, height) for box in boxes or ()
        ]
        pose = HERE
        if line.pose:
            poses = Pose.from_scene([line.pose])
            pose = Pose(poses.R[0], poses.t[0])
        yield Frame(line.time, image, K, None if boxes is None else tuple(checked), pose, lens, where)


def _pixels(detection: Detection) -> UInt8[np.ndarray, "height width 3"]:
    with pillow_warnings():
        return np.asarray(read_image(detection.file, detection.content))


def _at(detection: Detection, time: float, where: str) -> Detection:
    return replace(detection, line=detection.line.model_copy(update={"time": time, "box": None}), where=where)


def _of(boxes: Boxes, number: int) -> Sequence[Box] | None:
    return None if boxes is None else boxes.get(number, ())

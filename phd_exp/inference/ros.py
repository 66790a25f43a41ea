"""Predictions, fused positions and paths as messages of ROS 2, with their images and cameras.

Images of PNG and JPEG files keep their bytes; others become PNG, and the frames of a path JPEG. Detections without a
time have their number as seconds.
"""

import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image
from scipy.spatial.transform import Rotation

from phd_exp.fusion import Pose
from phd_exp.inference.answers import Sighting, together
from phd_exp.inference.following import HERE, Followed
from phd_exp.records.detections import Detection
from phd_exp.records.errors import DatasetError
from phd_exp.records.messages import SECOND, WORLD, Located, MessageFile, Photograph, optical_frame
from phd_exp.records.own_images import Observed, views_of

CAMERA = "camera"
LATEST = 2**31  # seconds, which a message holds in 32 bits
HOW = {"png": {"compress_level": 1}, "jpeg": {"quality": 95}}  # other levels take several times as long
MARKS = {"png": b"\x89PNG\r\n\x1a\n", "jpeg": b"\xff\xd8\xff"}
"""Format of image files -> their first bytes."""


def write_predictions(messages: MessageFile, sightings: Iterable[Sighting]) -> Iterator[Sighting]:
    """The sightings as they are; writes their positions in the frame of their camera.

    Raises DatasetError for a time that a message cannot hold.
    """
    for number, same in enumerate(together(sightings, lambda one: one.detection.file)):
        detection = same[0].detection
        time, recorded = _time(detection, number), detection.recorded
        frame = recorded.frame if recorded else optical_frame(CAMERA)
        messages.photograph(time, frame, CAMERA, _photograph(same[0]))
        messages.positions(time, frame, [_located(one) for one in same])
        yield from same


def write_views(
    messages: MessageFile, scenes: Sequence[Observed], sightings: Iterable[Sighting]
) -> Iterator[Sighting]:
    """The sightings of all scenes, one after the other, as they are; writes their images, cameras and poses."""
    for (number, k, scene), sighting in zip(views_of(scenes), sightings, strict=True):
        time, camera = _time(scene.detections[0], number), f"{CAMERA}_{k + 1}"
        messages.photograph(time, optical_frame(camera), camera, _photograph(sighting))
        messages.pose(time, optical_frame(camera), *_in_world(Pose.from_scene([scene.poses[k]])))
        yield sighting


def write_fused(messages: MessageFile, scenes: Sequence[Observed], answers: Sequence[Mapping[str, Any]]) -> None:
    """Write the fused position of each scene in the world of the poses; none for a scene without a result."""
    for number, (scene, answer) in enumerate(zip(scenes, answers, strict=True)):
        found = [Located(answer["mean"], answer["covariance"], id=str(scene.scene))]
        fused = bool(np.isfinite(answer["covariance"]).all())
        messages.positions(_time(scene.detections[0], number), WORLD, found if fused else [])


def write_path(
    messages: MessageFile, name: str, origin: int, frame: str, path: Iterable[Followed]
) -> Iterator[Followed]:
    """The frames of a path as they are; writes its positions in the frame of the camera, or the world of the poses.

    Args:
        messages: the file.
        name: of the object.
        origin: of the frames' times, ns.
        frame: name of the camera's frame.
        path: the frames with their states.
    """
    for one in path:
        shown, moves = one.frame, one.frame.pose is not HERE
        time, (height, width) = _nanoseconds(shown.where, shown.time, origin), shown.image.shape[:2]
        content = _encoded(Image.fromarray(shown.image), "jpeg")
        photograph = Photograph("jpeg", content, (width, height), shown.K, shown.lens)
        messages.photograph(time, frame, CAMERA, photograph)
        if moves:
            messages.pose(time, frame, *_in_world(shown.pose))
        found = []
        if one.state is not None:
            mean, covariance = (one.state.mean.numpy(), one.state.covariance.numpy()) if moves else one.in_camera
            found.append(Located(mean, covariance, id=f"{name}/{one.track}"))
        messages.positions(time, WORLD if moves else frame, found)
        yield one


def _time(detection: Detection, number: int) -> int:
    """The time of an image, ns; without one, its number in seconds."""
    if detection.recorded:
        return _nanoseconds(detection.where, 0.0, detection.recorded.time)
    time = detection.line.time
    return number * SECOND if time is None else _nanoseconds(detection.where, time)


def _nanoseconds(where: str, time: float, origin: int = 0) -> int:
    """The time (s) after an origin (ns), ns. Raises DatasetError for one that a message cannot hold."""
    if not 0 <= origin / SECOND + time < LATEST:
        raise DatasetError(
            f"{where}: time: got {origin / SECOND + time:g} s; messages have times from 0 to {LATEST} s"
        )
    return origin + round(time * SECOND)


def _located(sighting: Sighting) -> Located:
    """The mean and the covariance as they are predicted, in the frame of the real camera."""
    numbers, line = sighting.numbers, sighting.detection.line
    name, score = "" if line.category_id is None else str(line.category_id), 1.0 if line.score is None else line.score
    return Located(numbers["mean"], numbers["covariance"], name, score)


def _photograph(sighting: Sighting) -> Photograph:
    detection, image, camera = sighting.detection, sighting.image, sighting.view.camera
    content = detection.content
    kind = next((kind for kind, mark in MARKS.items() if content.startswith(mark)), None)
    if kind is None:
        kind, content = "png", _encoded(image, "png")
    return Photograph(kind, content, image.size, camera.K, camera.lens)


def _encoded(image: Image.Image, kind: str) -> bytes:
    stream = io.BytesIO()
    image.save(stream, kind, **HOW[kind])
    return stream.getvalue()


def _in_world(pose: Pose) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "4"]]:
    """The place of a camera in the world, and the quaternion (x, y, z, w) that turns its axes into the world's."""
    R, t = pose.R.double().numpy().reshape(3, 3), pose.t.double().numpy().reshape(3)
    return -R.T @ t, Rotation.from_matrix(R.T).as_quat()

"""Writing recordings of ROS 2 messages, as MCAP files, with `rosbags`, which the extra `ros` installs.

Positions are in metres, in the frame that a message names. That of a camera is ROS's optical frame (x right, y down,
z forward), which is also the camera frame of this package. The messages are those of ROS 2 Jazzy, and of vision_msgs
4, which Humble and later distributions have.

Source: REP 103 and 105; the definitions of vision_msgs, geometry_msgs, sensor_msgs and tf2_msgs.
"""

import fcntl
import os
from collections.abc import Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Float

from phd_exp.optics.lens import Lens
from phd_exp.records.cameras import COEFFICIENTS, CORNER
from phd_exp.records.errors import ConfigError, UserError, writing
from phd_exp.records.files import TEMPORARY

SECOND = 10**9  # nanoseconds
UNKNOWN = 1e6
"""Variance of each angle (rad²): the rotation is not estimated."""
WORLD = "world"
RAW, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
INFO = "sensor_msgs/msg/CameraInfo"
VISION = {
    "ObjectHypothesis": "string class_id\nfloat64 score",
    "ObjectHypothesisWithPose": "ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose",
    "BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "Detection3D": "std_msgs/Header header\nObjectHypothesisWithPose[] results\nBoundingBox3D bbox\nstring id",
    "Detection3DArray": "std_msgs/Header header\nDetection3D[] detections",
}
"""The fields of vision_msgs, which rosbags does not have."""
Content = dict[str, Any]
"""The fields of a message, nested."""


class Located(NamedTuple):
    """The position of an object: mean (m) and covariance (m²).

    A detector gives `class_id` and `score`. The `id` is the same in messages about the same object.
    """

    mean: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"]
    class_id: str = ""
    score: float = 1.0
    id: str = ""


class Photograph(NamedTuple):
    """The bytes of an image file, its `format` (png or jpeg) and size (px); K (px) and lens of its camera."""

    format: str
    content: bytes
    size: tuple[int, int]
    K: Float[np.ndarray, "3 3"]
    lens: Lens


def require_rosbags(key: str) -> None:
    """Raise ConfigError, which names the key that needs rosbags, unless rosbags is installed."""
    if find_spec("rosbags") is None:
        raise ConfigError(f"{key}: recordings of ROS 2 need `pip install 'phd_exp[ros]'`")


@cache
def typestore() -> Any:
    """The definitions of the messages."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    for name, fields in VISION.items():
        store.register(get_types_from_msg(fields, f"vision_msgs/msg/{name}"))
    return store


def optical_frame(camera: str) -> str:
    """The name of a camera's optical frame, by ROS's convention."""
    return f"{camera}_optical_frame"


class MessageFile:
    """An MCAP file, written message by message. It replaces an earlier file at the end, also after an error.

    Times are in nanoseconds.
    """

    def __init__(self, file: Path) -> None:
        from rosbags.rosbag2 import StoragePlugin, Writer

        self.file = file
        # a recording is a folder to rosbags; its MCAP file is complete without the rest
        self._folder = TemporaryDirectory(prefix=f".{file.name}.", suffix=TEMPORARY, dir=file.parent)
        self._lock = os.open(self._folder.name, os.O_RDONLY)  # tells `remove_temporaries` that its writer lives
        fcntl.flock(self._lock, fcntl.LOCK_SH)
        self._writer = Writer(Path(self._folder.name) / "all", version=8, storage_plugin=StoragePlugin.MCAP)
        self._writer.open()
        self._connections: dict[str, Any] = {}

    def positions(self, time: int, frame: str, objects: Sequence[Located]) -> None:
        """Write `/detections`, and `/position` for each object."""
        header, detections = _header(time, frame), []
        for one in objects:
            pose, hypothesis = _pose(one), {"class_id": one.class_id, "score": one.score}
            box = {"center": pose["pose"], "size": _numbers("xyz", np.zeros(3))}
            results = [{"hypothesis": hypothesis, "pose": pose}]
            detections.append({"header": header, "results": results, "bbox": box, "id": one.id})
            stamped = {"header": header, "pose": pose}
            self._write("/position", time, "geometry_msgs/msg/PoseWithCovarianceStamped", stamped)
        found = {"header": header, "detections": detections}
        self._write("/detections", time, "vision_msgs/msg/Detection3DArray", found)

    def photograph(self, time: int, frame: str, camera: str, photograph: Photograph) -> None:
        """Write `/CAMERA/image_raw/compressed` and `/CAMERA/camera_info`."""
        header, data = _header(time, frame), np.frombuffer(photograph.content, np.uint8)
        image = {"header": header, "format": photograph.format, "data": data}
        self._write(f"/{camera}/image_raw/compressed", time, COMPRESSED, image)
        self._write(f"/{camera}/camera_info", time, INFO, {"header": header} | _camera(photograph))

    def pose(self, time: int, frame: str, place: Float[np.ndarray, "3"], turn: Float[np.ndarray, "4"]) -> None:
        """Write `/tf`: the place (m) of a frame in the world, and the quaternion (x, y, z, w) of its axes."""
        transform = {"translation": _numbers("xyz", place), "rotation": _numbers("xyzw", turn)}
        stamped = {"header": _header(time, WORLD), "child_frame_id": frame, "transform": transform}
        self._write("/tf", time, "tf2_msgs/msg/TFMessage", {"transforms": [stamped]})

    def _write(self, topic: str, time: int, kind: str, content: Content) -> None:
        store = typestore()
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=store)
        with writing(self.file, "out=", UserError):
            self._writer.write(self._connections[topic], time, store.serialize_cdr(_message(kind, content), kind))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, place: TracebackType | None
    ) -> None:
        os.close(self._lock)
        with writing(self.file, "out=", UserError), self._folder:
            self._writer.close()
            if error is None or self._connections:
                os.replace(Path(self._folder.name) / "all" / "all.mcap", self.file)


def _message(kind: str, content: Content) -> Any:
    """The message of a type with the fields in nested mappings."""
    fields = dict(typestore().fielddefs[kind][1])
    return typestore().types[kind](**{name: _field(fields[name][1], value) for name, value in content.items()})


def _field(kind: Any, value: Any) -> Any:
    if isinstance(value, dict):
        return _message(kind, value)
    return [_message(kind[0][1], item) for item in value] if isinstance(value, list) else value


def _header(time: int, frame: str) -> Content:
    return {"stamp": {"sec": time // SECOND, "nanosec": time % SECOND}, "frame_id": frame}


def _numbers(names: str, values: Float[np.ndarray, " numbers"]) -> Content:
    return dict(zip(names, map(float, values), strict=True))


def _pose(located: Located) -> Content:
    """The axes are those of the frame, with variances that say how little this means."""
    covariance = np.diag([0.0, 0.0, 0.0, UNKNOWN, UNKNOWN, UNKNOWN])
    covariance[:3, :3] = located.covariance
    no_turn = _numbers("xyzw", np.array([0.0, 0.0, 0.0, 1.0]))
    pose = {"position": _numbers("xyz", located.mean), "orientation": no_turn}
    return {"pose": pose, "covariance": covariance.ravel()}


def _camera(photograph: Photograph) -> Content:
    """The fields of a `camera_info`; ROS counts pixels from the centre of the first one."""
    (width, height), lens = photograph.size, photograph.lens
    K = photograph.K - CORNER * np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])
    of_pinhole = "plumb_bob" if len(lens.coefficients) <= 5 else "rational_polynomial"
    model = "equidistant" if lens.is_fisheye else of_pinhole
    D = np.zeros(len(COEFFICIENTS[model]))
    D[: len(lens.coefficients)] = lens.coefficients
    matrices = {"d": D, "k": K.ravel(), "r": np.eye(3).ravel(), "p": np.c_[K, np.zeros(3)].ravel()}
    region = dict.fromkeys(("x_offset", "y_offset", "height", "width"), 0) | {"do_rectify": False}
    readout = {"binning_x": 0, "binning_y": 0, "roi": region}
    return {"height": height, "width": width, "distortion_model": model} | matrices | readout

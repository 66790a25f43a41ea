"""Images and `camera_info` of a ROS 2 recording: an MCAP or SQLite file, or a rosbag2 folder with such files.

`rosbags`, which the extra `ros` installs, reads them, one chunk at a time. Messages are decoded by the definitions of
ROS 2, not by those in a stranger's file.

Source: the definitions of sensor_msgs; image_pipeline's names of topics.
"""

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from phd_exp.records.cameras import Calibration, calibration_in, read_camera
from phd_exp.records.detections import Detection, RecordedImage, line_of
from phd_exp.records.errors import DatasetError, listed, reading, shown
from phd_exp.records.files import require_plain
from phd_exp.records.images import FORMATS, decoding, pillow_warnings
from phd_exp.records.messages import COMPRESSED, INFO, RAW, SECOND, require_rosbags, typestore

MCAP = ".mcap"
FILES = (MCAP, ".db3", ".bag")
GREY, RGB, BGR = [0], [0, 1, 2], [2, 1, 0]
ENCODINGS = {
    **{"mono8": (1, GREY), "8UC1": (1, GREY), "mono16": (2, GREY)},
    **{"rgb8": (3, RGB), "bgr8": (3, BGR), "8UC3": (3, BGR), "rgba8": (4, RGB), "bgra8": (4, BGR)},
}
"""Encoding of an image that is not compressed -> bytes a pixel, and the places of its colours; 8UC3 as in OpenCV."""
DAMAGED = (
    "copy the file again; if its writer was interrupted, `mcap recover` or `ros2 bag reindex` repairs it; bags of "
    "ROS 1 need `rosbags-convert`"
)
RECTIFIED = "image_rect"
"""Beginning of the names of topics whose images have no distortion, and the camera P instead of K."""


def is_recording(path: Path) -> bool:
    """Whether a path is a recording: an MCAP or SQLite file, or a folder with rosbag2's `metadata.yaml`."""
    return (path.suffix in FILES and not path.is_dir()) or (path / "metadata.yaml").is_file()


@dataclass(frozen=True, eq=False)
class Recording:
    """The images of one topic with their camera, as detections in the order in which they were recorded.

    Attributes:
        path: of the recording.
        topic: of the images.
        template: a detection without an image.
        infos: the topic of the camera; None for a camera from elsewhere.
        n: number of images.
        start: time of the first one (ns).
        frame: name of the camera's frame.
    """

    path: Path
    topic: str
    template: Detection
    infos: str | None
    n: int
    start: int
    frame: str

    @classmethod
    def of(cls, path: Path, topic: str | None, camera: Mapping[str, Any]) -> "Recording":
        """The images of a topic (IMAGE, or IMAGE,CAMERA_INFO), which only a recording of several cameras needs.

        `camera` has the keys of a camera, of a `DetectionLine`, that replace `camera_info`, and a box.

        Raises ConfigError without rosbags; DatasetError if the recording cannot be read, the topics are unclear, or
        there is no camera or no image.
        """
        require_rosbags("folder")
        with _opened(path) as reader:
            found = [one for one in reader.connections if one.msgcount]
            counts = {(one.topic, _kind(one)): one.msgcount for one in found}
        topics = dict(counts.keys())
        name, _, given = (topic or "").partition(",")
        images = _chosen(path, name, [one for one, kind in topics.items() if kind in (RAW, COMPRESSED)])
        infos, calibration, (time, message) = None, None, _first(path, images)
        if camera.keys() <= {"box"}:
            infos = _info_of(path, images, given, [one for one, kind in topics.items() if kind == INFO])
            calibration = _calibration(path, images, infos, _first(path, infos)[1], _size_of(message))
            camera = {"camera": infos, **camera}
        elif "camera" in camera:
            calibration = read_camera(Path(camera["camera"]))
        line = line_of({"file_name": images, **camera}, str(path))
        n = counts[images, topics[images]]
        template = Detection(line, path, str(path), calibration)
        return cls(path, images, template, infos, n, _time(message, time), str(message.header.frame_id))

    def __len__(self) -> int:
        """The number of images."""
        return self.n

    def __iter__(self) -> Iterator[Detection]:
        """The images one by one. Raises DatasetError, after those before, where one cannot be read."""
        n = 0
        camera = self.template.calibration
        for time, topic, message in _messages(self.path, [self.topic, *([self.infos] if self.infos else [])]):
            time = _time(message, time)
            stamp = f"{time // SECOND}.{time % SECOND:09}"
            where = f"{self.path}, {topic} at {stamp}"
            if topic == self.infos:
                size = (camera.width, camera.height) if camera and camera.width and camera.height else None
                if _calibration(self.path, self.topic, topic, message, size) != camera:
                    raise DatasetError(f"{where}: the camera changes; expected one camera; cut the recording there")
                continue
            image = RecordedImage(_image_file(where, message), time, str(message.header.frame_id))
            line = self.template.line.model_copy(update={"file_name": stamp})
            yield replace(self.template, line=line, file=self.path / stamp, where=where, recorded=image)
            n += 1
        if n != self.n:
            raise DatasetError(f"{self.path}: got {n} images of {self.topic}; expected {self.n}; copy the file again")


def _chosen(path: Path, name: str, topics: list[str]) -> str:
    """The topic of the images."""
    if name in topics or (not name and len(topics) == 1):
        return name or topics[0]
    if not topics:
        raise DatasetError(f"{path}: has no images; expected a topic of {RAW} or {COMPRESSED}")
    got = f"got {shown(name)}" if name else f"{len(topics)} topics of images"
    raise DatasetError(f"{path}: topic: {got}; expected topic=NAME, one of {listed(sorted(topics))}")


def _info_of(path: Path, images: str, name: str, topics: list[str]) -> str:
    """The topic of a camera: the given one, or that next to the images."""
    base = images.removesuffix("/compressed").rpartition("/")[0]
    name = name or f"{base}/camera_info"
    if name in topics:
        return name
    found = f"found {listed(sorted(topics))}" if topics else "found none"
    raise DatasetError(
        f"{path}: no camera_info of {images}: {found}; expected {name}, topic={images},CAMERA_INFO, or camera=FILE "
        "or f=PIXELS"
    )


def _calibration(path: Path, images: str, infos: str, message: Any, image: tuple[int, int] | None) -> Calibration:
    """The camera of a `camera_info`; ROS counts pixels from the centre of the first one, as camera files do."""
    sensor = {name: getattr(message, name) for name in ("width", "height", "binning_x", "binning_y")}
    sensor["roi"] = vars(message.roi)
    camera = {"K": message.k.tolist(), "D": message.d.tolist(), "distortion_model": message.distortion_model}
    if images.removesuffix("/compressed").rpartition("/")[2].startswith(RECTIFIED):
        camera = {"K": message.p.reshape(3, 4)[:, :3].ravel().tolist(), "D": []}
    with reading(f"{path}, {infos}", "expected a calibrated camera, or camera=FILE"):
        return calibration_in(sensor | camera, image)


def _size_of(message: Any) -> tuple[int, int] | None:
    """Width and height of an image; None if it is broken, which its reading reports."""
    if message.__msgtype__ != COMPRESSED:
        return message.width, message.height
    with suppress(DatasetError), pillow_warnings(), decoding(Path()):
        return Image.open(io.BytesIO(bytes(message.data)), formats=FORMATS).size
    return None


def _time(message: Any, recorded: int) -> int:
    """The time at which a message was taken (ns); if it does not say, that of its recording."""
    time: int = message.header.stamp.sec * SECOND + message.header.stamp.nanosec
    return time if time > 0 else recorded


def _image_file(where: str, message: Any) -> bytes:
    """The bytes of an image file: those of a compressed image, or a PPM or TIFF with the pixels of another one."""
    if message.__msgtype__ == COMPRESSED:
        return bytes(message.data)
    encoding = message.encoding
    if encoding not in ENCODINGS:
        raise DatasetError(
            f"{where}: got the encoding {shown(encoding)}; expected {', '.join(ENCODINGS)}, or a compressed image; "
            "convert it with image_proc or cv_bridge"
        )
    bands, colours = ENCODINGS[encoding]
    height, width, step = message.height, message.width, message.step
    if not 0 < width * bands <= step or height * step != len(message.data):
        raise DatasetError(
            f"{where}: got {len(message.data)} bytes for {width} x {height} pixels of {encoding} in rows of {step}; "
            "expected height x step"
        )
    pixels = message.data.reshape(height, step)[:, : width * bands].reshape(height, width, bands)
    if bands == 2:
        order = ">u2" if message.is_bigendian else "<u2"
        stream = io.BytesIO()
        Image.fromarray(np.ascontiguousarray(pixels).view(order)[..., 0].astype(np.uint16)).save(stream, "TIFF")
        return stream.getvalue()
    kind = 5 if colours == GREY else 6
    return b"P%d %d %d 255\n" % (kind, width, height) + np.ascontiguousarray(pixels[..., colours]).tobytes()


def _first(path: Path, topic: str) -> tuple[int, Any]:
    """Time of recording (ns) and content of the first message."""
    for time, _, message in _messages(path, [topic]):
        return time, message
    raise DatasetError(f"{path}: got no message of {topic}, which its index names; copy the file again")


def _messages(path: Path, topics: list[str]) -> Iterator[tuple[int, str, Any]]:
    """The messages of some topics: time of recording (ns), topic, and content."""
    with _opened(path) as reader:
        wanted = [one for one in reader.connections if one.topic in topics]
        for connection, time, data in reader.messages(wanted):
            yield time, connection.topic, typestore().deserialize_cdr(data, _kind(connection))


def _kind(connection: Any) -> str:
    """The type of the messages; early recordings of ROS 2 have `sensor_msgs/Image`, without `msg`."""
    package, _, name = connection.msgtype.rpartition("/")
    return f"{package.removesuffix('/msg')}/msg/{name}"


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The recording as rosbags reads it; errors in the body are those of the recording."""
    from rosbags.rosbag2 import Reader

    with reading(path, DAMAGED, what="cannot be read as a recording of ROS 2"):
        if not path.is_dir():
            require_plain(path)
        with Reader(path) as reader:
            yield reader


Detections = Sequence[Detection] | Recording

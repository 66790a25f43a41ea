"""Recordings of ROS 2, written and read by `mcap-ros2-support`, which is not the library of the package."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from phd_exp.records.messages import COMPRESSED, INFO, RAW, SECOND, typestore

FRAME = "front_optical_frame"


class Message(NamedTuple):
    """A message to write: its topic, type, time (ns) and content."""

    topic: str
    kind: str
    time: int
    content: dict[str, Any]


def image(array: np.ndarray, encoding: str, time: int, topic: str = "/front/image_raw", padding: int = 3) -> Message:
    """An image that is not compressed, of RGB pixels or grey ones, with bytes between the rows; alpha is 0."""
    stored = array[..., ::-1] if encoding in ("bgr8", "bgra8", "8UC3") else array
    stored = np.pad(stored, ((0, 0), (0, 0), (0, 1))) if encoding in ("rgba8", "bgra8") else stored
    stored = (array * np.uint16(256)).astype("<u2").view(np.uint8) if encoding == "mono16" else stored
    height, width = array.shape[:2]
    rows = np.pad(stored.reshape(height, -1), ((0, 0), (0, padding)))
    content = {"height": height, "width": width, "encoding": encoding, "is_bigendian": 0, "step": rows.shape[1]}
    return Message(topic, RAW, time, content | {"data": rows.tobytes()})


def compressed(content: bytes, kind: str, time: int, topic: str = "/front/image_raw/compressed") -> Message:
    """An image file."""
    return Message(topic, COMPRESSED, time, {"format": kind, "data": content})


def info(
    size: tuple[int, int], K: Iterable[float], time: int, topic: str = "/front/camera_info", **more: Any
) -> Message:
    """A camera, by default without distortion."""
    K = list(map(float, K))
    region = dict.fromkeys(("x_offset", "y_offset", "height", "width"), 0) | {"do_rectify": False}
    P = [*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0]
    content: dict[str, Any] = {"width": size[0], "height": size[1], "distortion_model": "plumb_bob", "d": [0.0] * 5}
    content |= {"k": K, "r": [1.0, 0, 0, 0, 1, 0, 0, 0, 1], "p": P, "binning_x": 0, "binning_y": 0, "roi": region}
    return Message(topic, INFO, time, content | more)


def write(file: Path, messages: Iterable[Message], frame: str = FRAME) -> Path:
    """Write an MCAP file; the header of each message has its time."""
    from mcap_ros2.writer import Writer

    with open(file, "wb") as stream, Writer(stream) as writer:
        schemas: dict[str, Any] = {}
        for topic, kind, time, content in messages:
            if kind not in schemas:
                definition, _ = typestore().generate_msgdef(kind, ros_version=2)
                schemas[kind] = writer.register_msgdef(kind, definition)
            stamp = {"sec": time // SECOND, "nanosec": time % SECOND}
            message = {"header": {"stamp": stamp, "frame_id": frame}} | content
            writer.write_message(topic, schemas[kind], message, log_time=time + 1000)
    return file


def read(file: Path) -> Iterator[tuple[str, Any]]:
    """Topic and content of all messages, by time."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with open(file, "rb") as stream:
        for _, channel, _, message in make_reader(stream, True, [DecoderFactory()]).iter_decoded_messages():
            yield channel.topic, message


def time_of(message: Any) -> int:
    """The time in the header of a message, ns."""
    return int(message.header.stamp.sec * SECOND + message.header.stamp.nanosec)

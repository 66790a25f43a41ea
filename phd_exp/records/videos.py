"""Video files, decoded and encoded one frame at a time by PyAV, which the extra `video` installs."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import UInt8

from phd_exp.records.errors import ConfigError, DatasetError, gist
from phd_exp.records.files import require_plain

CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,flv,asf,ogg,mxf"
"""FFmpeg's names of the formats that are read: each is one file. Others, such as playlists, name further files."""
LONGEST_WAIT = 30.0  # seconds for one packet; signals are handled between packets
CLOCK = 90_000  # ticks a second of a written video, as in broadcasting
FRAGMENTED = {"movflags": "frag_keyframe+empty_moov+default_base_moof"}  # what is written can be played after a kill
KEY_FRAMES = 30  # frames from one to the next, at most
QUALITY = {"preset": "veryfast", "crf": "20", "tune": "zerolatency"}  # without frames that are shown later


class Shot(NamedTuple):
    """One frame of a video: its number from 0, its time (seconds) in the file, and its RGB pixels."""

    number: int
    time: float
    image: UInt8[np.ndarray, "height width 3"]


def require_av(key: str) -> None:
    """Raise ConfigError, which names the key that needs PyAV, unless PyAV is installed."""
    if find_spec("av") is None:
        raise ConfigError(f"{key}: videos need `pip install 'phd_exp[video]'`")


def length_of(file: Path) -> int | None:
    """The number of frames that a video file names or that follows from its duration; None if it names neither."""
    with _opened(file) as (container, stream):
        if not stream.frames and container.duration and stream.average_rate:
            return int(container.duration / 1e6 * stream.average_rate)
        return stream.frames or None


def shots_in(file: Path, stride: int = 1) -> Iterator[Shot]:
    """Every `stride`-th frame of a video; one is held at a time.

    Raises DatasetError, after the frames before, if the file is no whole video of upright frames of one size with
    increasing times, or has no frame.
    """
    number, before, longest = 0, -np.inf, 0.0
    with _opened(file) as (container, stream):
        for frame in _decoded(file, container, stream):
            _require_alike(f"{file}, frame {number}", frame, stream, before)
            if number % stride == 0:
                yield Shot(number, frame.time, frame.to_ndarray(format="rgb24"))
            longest = max(longest, frame.time - before if number else 0.0)
            number, before = number + 1, frame.time
        end = _end_of(stream)
    if number == 0:
        raise DatasetError(f"{file}: no frame can be decoded; expected a video with a key frame")
    if number > 1 and before + 2 * longest < end:  # decoders pass over some broken frames in silence
        raise DatasetError(f"{file}: ends at {before:g} s of {end:g} s, after {number} frames; copy the file again")


def _end_of(stream: Any) -> float:
    """The time (seconds) at which the last frame ends as a file of MKV or WEBM states it; 0 without one."""
    clock = re.fullmatch(r"(\d+):(\d+):(\d+(?:\.\d+)?)", stream.metadata.get("DURATION", "").strip("\0 "))
    return sum(float(part) * unit for part, unit in zip(clock.groups(), (3600, 60, 1), strict=True)) if clock else 0.0


def _decoded(file: Path, container: Any, stream: Any) -> Iterator[Any]:
    """The frames from the first key frame on."""
    number, is_begun = 0, False
    for packet in _packets(file, container, stream):
        is_begun |= packet.is_keyframe
        if packet.is_corrupt:
            raise DatasetError(f"{file}: ends in the middle of a frame, after {number} frames; copy the file again")
        if not is_begun and packet.size:
            continue
        with _reading(f"{file}, after {number} frames"):
            frames = packet.decode()
        for frame in frames:
            if frame.is_corrupt:
                raise DatasetError(f"{file}, frame {number}: is damaged; copy the file again")
            yield frame
            number += 1


def _packets(file: Path, container: Any, stream: Any) -> Iterator[Any]:
    packets = container.demux(stream)
    while True:
        with _reading(str(file)):
            packet = next(packets, None)
        if packet is None:
            return
        yield packet


def _require_alike(where: str, frame: Any, stream: Any, before: float) -> None:
    width, height = stream.width, stream.height
    if (frame.width, frame.height) != (width, height):
        raise DatasetError(
            f"{where}: got {frame.width} x {frame.height} pixels; expected {width} x {height} as in the first frame; "
            "cut the video there"
        )
    if frame.rotation:
        raise DatasetError(
            f"{where}: is turned by {abs(frame.rotation)} degrees; encode it upright (`ffmpeg -i FILE OTHER`), "
            "and let the camera and the boxes refer to the result"
        )
    if frame.time is None or not frame.time > before:
        after = "" if frame.time is None else f" after {before:g} s"
        got = "no time" if frame.time is None else f"time {frame.time:g} s"
        raise DatasetError(f"{where}: got {got}{after}; expected increasing times; encode the video again")


@contextmanager
def _opened(file: Path) -> Iterator[tuple[Any, Any]]:
    """The container and its first stream of images."""
    import av

    with _reading(str(file)):
        require_plain(file)
        reads = {"format_whitelist": CONTAINERS, "protocol_whitelist": "file"}
        container = av.open(f"file:{file}", options=reads, timeout=LONGEST_WAIT)
    with container:
        if not container.streams.video:
            raise DatasetError(f"{file}: has no images; expected a video")
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        stream.codec_context.options = {"err_detect": "explode"}  # refuse broken frames instead of guessing them
        yield container, stream


@contextmanager
def _reading(where: str) -> Iterator[None]:
    """Turn the errors of files and decoders into a DatasetError."""
    from av.error import FFmpegError

    try:
        yield
    except (OSError, FFmpegError) as error:
        reason = f"{where}: cannot be read as a video ({gist(error)})"
        raise DatasetError(f"{reason}; expected a whole file of MP4, MOV, MKV, WEBM, AVI, OGG, TS or MPEG") from None


class VideoWriter:
    """An MP4 file (H.264) that is written frame by frame; of a killed process, what it has written can be played."""

    def __init__(self, file: Path, size: tuple[int, int]) -> None:
        """`size`: even width and height, px."""
        import av

        self._file = file.open("wb")  # to FFmpeg, a file that it opens itself is whole on a full disk too
        self._container: Any = av.open(self._file, "w", format="mp4", options=FRAGMENTED)
        self._stream: Any = self._container.add_stream("libx264", rate=30, options=QUALITY)
        self._stream.width, self._stream.height = size
        self._stream.pix_fmt = "yuv420p"
        self._stream.codec_context.time_base = Fraction(1, CLOCK)
        self._stream.codec_context.gop_size = KEY_FRAMES
        self._first: float | None = None

    def add(self, time: float, image: UInt8[np.ndarray, "height width 3"]) -> None:
        """Append an image at a later time (seconds); the first one becomes 0."""
        import av

        self._first = time if self._first is None else self._first
        frame = av.VideoFrame.from_ndarray(image, format="rgb24")
        frame.pts, frame.time_base = round((time - self._first) * CLOCK), Fraction(1, CLOCK)
        self._container.mux(self._stream.encode(frame))
        self._file.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, place: TracebackType | None
    ) -> None:
        with self._file, self._container:
            self._container.mux(self._stream.encode())

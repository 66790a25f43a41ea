"""Video files, decoded and encoded one frame at a time by PyAV, which the extra `video` installs."""

from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import UInt8

from phd_exp.records.errors import ConfigError, reading
from phd_exp.records.files import require_plain

CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,flv,asf,ogg,mxf"
"""FFmpeg's names of the formats that are read: each is one file. Others, such as playlists, name further files."""
LONGEST_WAIT = 30.0  # seconds for one packet; signals are handled between packets
CLOCK = 90_000  # ticks a second of a written video, as in broadcasting
FRAGMENTED = {"movflags": "frag_keyframe+empty_moov+default_base_moof"}  # what is written can be played after a kill
WHOLE = "expected a whole file of MP4, MOV, MKV, WEBM, AVI, OGG, TS or MPEG, upright and with increasing times"
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
    """Every `stride`-th frame of a video, from its first key frame on; one is held at a time.

    Raises DatasetError, after the frames before, if the file is no whole video of upright frames of one size with
    increasing times, or has no frame.
    """
    number, before, longest, is_begun = 0, -np.inf, 0.0, False
    with _opened(file) as (container, stream):
        for packet in container.demux(stream):
            is_begun |= packet.is_keyframe
            if packet.is_corrupt:
                raise ValueError(f"ends in the middle of a frame, after {number} frames")
            for frame in packet.decode() if is_begun or not packet.size else ():
                _require_alike(number, frame, stream, before)
                if number % stride == 0:
                    yield Shot(number, frame.time, frame.to_ndarray(format="rgb24"))
                longest = max(longest, frame.time - before if number else 0.0)
                number, before = number + 1, frame.time
        if number == 0:
            raise ValueError("no frame can be decoded; expected a video with a key frame")
        # decoders pass over some broken frames in silence; other formats only estimate a duration
        end = container.duration / 1e6 if "matroska" in container.format.name and container.duration else 0.0
        if number > 1 and before + 2 * longest < end:
            raise ValueError(f"ends at {before:g} s of {end:g} s, after {number} frames")


def _require_alike(number: int, frame: Any, stream: Any, before: float) -> None:
    """Raise ValueError for a frame that is damaged, turned, of another size than the first, or not later."""
    size, first = (frame.width, frame.height), (stream.width, stream.height)
    faults = {
        "is damaged": frame.is_corrupt,
        f"has {size} pixels; expected {first} as the first": size != first,
        f"is turned by {abs(frame.rotation)} degrees; turn it for good (`ffmpeg -i FILE OTHER`)": frame.rotation,
        f"has the time {frame.time} s after {before:g} s": frame.time is None or not frame.time > before,
    }
    for fault in (fault for fault, is_there in faults.items() if is_there):
        raise ValueError(f"frame {number}: {fault}")


@contextmanager
def _opened(file: Path) -> Iterator[tuple[Any, Any]]:
    """The container and its first stream of images; errors in the body are those of the file."""
    import av

    with reading(file, WHOLE, what="cannot be read as a video"):
        require_plain(file)
        reads = {"format_whitelist": CONTAINERS, "protocol_whitelist": "file"}
        with av.open(f"file:{file}", options=reads, timeout=LONGEST_WAIT) as container:
            if not container.streams.video:
                raise ValueError("has no images")
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            stream.codec_context.options = {"err_detect": "explode"}  # refuse broken frames instead of guessing them
            yield container, stream


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

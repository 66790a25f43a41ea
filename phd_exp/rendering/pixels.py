"""Pixels: linear light, 8-bit sRGB (IEC 61966-2-1), and the files of both."""

import io
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from phd_exp.records.spec import DatasetSpec, ImageFormat

Light = NDArray[np.float64]
Pixels = NDArray[np.uint8]


class Box(NamedTuple):
    """Pixels left <= column < right and top <= row < bottom."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Its rows and columns of an image."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    @property
    def middles(self) -> tuple[Light, Light]:
        """Coordinates x and y (height, width) of the middles of its pixels."""
        x, y = np.meshgrid(np.arange(self.left, self.right) + 0.5, np.arange(self.top, self.bottom) + 0.5)
        return x, y

    def within(self, other: "Box") -> "Box":
        """Its part in another box, perhaps empty."""
        left, top = max(self.left, other.left), max(self.top, other.top)
        right, bottom = min(self.right, other.right), min(self.bottom, other.bottom)
        return Box(left, top, max(left, right), max(top, bottom))


# Level 9 of zlib saves 2 % of the bytes for twice the time. A JPEG has colour at full resolution, since a silhouette
# is often a step in colour alone.
OPTIONS: dict[ImageFormat, dict[str, Any]] = {
    "png": {"compress_level": 6},
    "webp": {"method": 4},
    "jpeg": {"subsampling": 0},
}


def linear(signal: float) -> float:
    """The linear light of an sRGB signal from 0 to 1."""
    return signal / 12.92 if signal <= 0.04045 else ((signal + 0.055) / 1.055) ** 2.4


def encoded(light: Light) -> Pixels:
    """Linear light to 8-bit sRGB, clipped to its range."""
    return np.searchsorted(_STEPS, light, side="right").astype(np.uint8)


_STEPS: Light = np.array([linear((value + 0.5) / 255) for value in range(255)])
"""The light at which the nearest 8-bit value becomes the next one."""


def encode(pixels: Pixels, spec: DatasetSpec) -> bytes:
    """Image (S, S, 3) as the bytes of a file of the specification's format and quality."""
    quality = {} if spec.image_format == "png" else {"quality": spec.image_quality}
    image = Image.fromarray(pixels)
    image = image.convert("L").convert("RGB") if spec.grey else image
    return file_of(image, spec.image_format, **OPTIONS[spec.image_format], **quality)


def file_of(image: Image.Image, image_format: ImageFormat, **options: Any) -> bytes:
    """An image as the bytes of a file."""
    stream = io.BytesIO()
    image.save(stream, format=image_format.upper(), **options)
    return stream.getvalue()


def read_light(content: bytes, height: int, width: int, channels: int = 3) -> NDArray[np.float64]:
    """Linear light (height, width, channels), rows from the top, from an OpenEXR file of a `Renderer`.

    The file has half floats in uncompressed blocks of one row; a fourth channel is the opacity. In background mode,
    Blender returns pixels through files only, and only OpenEXR keeps the light of an overexposed pixel.

    Raises ValueError if the file has another format or size.

    Source: "OpenEXR file layout" in the OpenEXR documentation. The rows are at the end of the file; each has its
    number and length (int32), then opacity, blue, green and red.
    """
    row = np.dtype([("number", "<i4"), ("length", "<i4"), ("light", "<f2", (channels, width))])
    begin = len(content) - height * row.itemsize
    if content[:4] != b"\x76\x2f\x31\x01" or begin <= 0:
        raise ValueError(f"not an uncompressed OpenEXR file of {width} x {height} pixels")
    rows = np.frombuffer(content, row, count=height, offset=begin)
    steps = np.diff(rows["number"])
    if (rows["length"] != 2 * channels * width).any() or (steps != 1).any():
        raise ValueError(f"an OpenEXR file, but not of {height} rows of {width} pixels in half floats")
    return rows["light"][:, ::-1].transpose(0, 2, 1).astype(np.float64)

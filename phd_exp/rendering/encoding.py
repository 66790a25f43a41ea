"""Pixels to files: the same bytes for the same pixels. Blender's own files carry times and never repeat."""

import io
from typing import Any

from PIL import Image

from phd_exp.records.spec import DatasetSpec, ImageFormat
from phd_exp.rendering.colour import Pixels

# Level 6 of zlib: level 9 saves 2 % of the bytes for twice the time. Colour at full resolution in a JPEG: a
# silhouette is often a step in colour alone.
OPTIONS: dict[ImageFormat, dict[str, Any]] = {
    "png": {"compress_level": 6},
    "webp": {"method": 4},
    "jpeg": {"subsampling": 0},
}


def encode(pixels: Pixels, spec: DatasetSpec) -> bytes:
    """Image (S, S, 3) as the bytes of a file of the specification's format and quality."""
    options = OPTIONS[spec.image_format]
    if spec.image_format != "png":
        options = options | {"quality": spec.image_quality}
    return file_of(Image.fromarray(pixels), spec.image_format, **options)


def file_of(image: Image.Image, image_format: ImageFormat, **options: Any) -> bytes:
    """An image as the bytes of a file."""
    stream = io.BytesIO()
    image.save(stream, format=image_format.upper(), **options)
    return stream.getvalue()

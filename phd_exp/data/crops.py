"""The user's own images: read with care, and seen by virtual cameras."""

import io
import math
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import ExifTags, Image

from phd_exp.data.images import shrunk
from phd_exp.geometry.virtual import VirtualCamera
from phd_exp.records.errors import DatasetError
from phd_exp.records.files import require_plain
from phd_exp.records.images import FORMATS, LARGEST_IMAGE, decoding, pillow_warnings

GREY = (128, 128, 128)
"""What a virtual camera sees where the image has nothing: beyond its edges, and where it is transparent."""
PLAIN = ("1", "L", "RGB", "YCbCr", "CMYK")
WITH_ALPHA = ("P", "PA", "LA", "La", "RGBA", "RGBa")  # a palette may hold a transparent colour
SIXTEEN_BITS = ("I;16", "I;16L", "I;16B", "I;16N")
ONE_PICTURE = ("JPEG", "MPO")
"""Kinds whose further frames, where there are any, are previews and depth maps of the first."""
MARGIN = 2
"""Pixels about a place that bicubic interpolation looks at."""
FINEST = 2
"""An image is enlarged to this multiple of its longer side at most, before its areas are averaged."""


def image_size(file: Path) -> tuple[int, int]:
    """Width and height, from the head of the file. Raises DatasetError where that is no image."""
    with decoding(file), pillow_warnings():
        require_plain(file, LARGEST_IMAGE)
        with Image.open(file, formats=FORMATS) as image:
            return image.size


def read_image(file: Path, content: bytes) -> Image.Image:
    """The image as RGB: grey, palette and 16 bits (the upper 8 of them) converted, transparency laid over grey.

    Raises DatasetError, naming the file, for what is no whole image or holds several, exceeds Pillow's limit of
    pixels, has an EXIF orientation (it is then unclear to which pixels the intrinsics refer), or has colours that are
    no RGB.
    """
    with decoding(file), Image.open(io.BytesIO(content), formats=FORMATS) as image:
        orientation = image.getexif().get(
            ExifTags.Base.Orientation, 1
        )  # first: Pillow turns a TIFF as it loads
        if orientation != 1:
            raise DatasetError(
                f"{file}: has the EXIF orientation {orientation}, so that its stored pixels are turned; "
                "turn them for good (`mogrify -auto-orient`), and let f, cx, cy and box refer to the result"
            )
        _require_one_picture(file, image)
        image.load()
        return _as_rgb(file, image)


def cut(image: Image.Image, camera: VirtualCamera) -> UInt8[np.ndarray, "S S 3"]:
    """What the virtual camera sees of the image of its real camera; grey beyond that image's edges.

    Bicubic at the middles of a whole multiple of S pixels a side, fine enough that no pixel of the image is skipped,
    then averaged over areas.
    """
    S = int(camera.S)
    finest = FINEST * max(image.size) / S
    multiple = max(1, math.ceil(min(camera.density, finest) - 1e-6))  # 2.0000000001 is two
    side = S * multiple
    back = np.linalg.inv(camera.homography) @ np.diag([1 / multiple, 1 / multiple, 1.0])
    return shrunk(_transformed(image, back, side), S)


def _transformed(image: Image.Image, back: Float[np.ndarray, "3 3"], side: int) -> Image.Image:
    """The square image whose pixel p shows what the given one has at back p, bicubic and rounded; grey beyond."""
    corners = back @ np.array([[0, side, 0, side], [0, 0, side, side], [1, 1, 1, 1]])
    size = np.array(image.size)[:, None]
    reached = (corners[:2] / corners[2]).clip(-MARGIN, size + MARGIN)
    left, top = np.floor(reached.min(axis=1) - MARGIN).clip(0).astype(int).tolist()
    right, bottom = np.ceil(reached.max(axis=1) + MARGIN).clip(None, size[:, 0]).astype(int).tolist()
    shifted = np.array([[1, 0, -left], [0, 1, -top], [0, 0, 1]]) @ back
    # Pillow takes the middle of an output pixel, (column + 1/2, row + 1/2), to input pixels counted in the same way
    coefficients = (shifted / shifted[2, 2]).flatten()[:8].tolist()
    # band by band in floating point: of whole bytes Pillow would cut off what lies behind the point
    bands = [
        band.convert("F").transform(
            (side, side), Image.Transform.PERSPECTIVE, coefficients, Image.Resampling.BICUBIC, fillcolor=grey
        )
        for band, grey in zip(image.crop((left, top, right, bottom)).split(), GREY, strict=True)
    ]
    levels = np.stack([np.asarray(band) for band in bands], axis=-1)
    return Image.fromarray(levels.round().clip(0, 255).astype(np.uint8))


def _require_one_picture(file: Path, image: Image.Image) -> None:
    if getattr(image, "is_animated", False) and image.format not in ONE_PICTURE:
        raise DatasetError(
            f"{file}: holds several pictures; expected one, save that which is meant by itself"
        )


def _as_rgb(file: Path, image: Image.Image) -> Image.Image:
    if image.mode in SIXTEEN_BITS:
        return Image.fromarray((np.asarray(image) >> 8).astype(np.uint8)).convert("RGB")
    if image.mode in WITH_ALPHA:
        over = image.convert("RGBA")
        return Image.alpha_composite(Image.new("RGBA", image.size, (*GREY, 255)), over).convert("RGB")
    if image.mode in PLAIN:
        return image.convert("RGB")
    raise DatasetError(f"{file}: has colours of the kind {image.mode!r}; save it as RGB of 8 bits")

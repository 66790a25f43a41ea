"""Image files, possibly made by a stranger: decoded within limits, or refused in one line."""

import io
import struct
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image, Jpeg2KImagePlugin, TiffImagePlugin, UnidentifiedImageError, WebPImagePlugin

from phd_exp.records.dataset import sha256
from phd_exp.records.errors import DatasetError, gist
from phd_exp.records.files import MB, read_plain
from phd_exp.records.scenes import SampleRecord

# plugins that Pillow loads only after all others have failed
_LATER = (TiffImagePlugin, WebPImagePlugin, Jpeg2KImagePlugin)
FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "GIF", "PPM", "JPEG2000")
"""Formats that are tried on a file, whatever its name. Pillow has more, such as EPS, whose code Ghostscript runs."""
SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".gif", ".ppm", ".pgm", ".pbm", ".jp2")
"""Endings of their names, to find the images in a folder with other files."""
RENDERED = ("PNG", "WEBP", "JPEG")
LARGEST_IMAGE = 256 * MB  # bytes of an image file
BROKEN = (
    OSError, SyntaxError, ValueError, LookupError, EOFError, OverflowError, MemoryError, struct.error, zlib.error,
)  # fmt: skip
"""Exceptions of Pillow's decoders on broken files."""


@contextmanager
def pillow_warnings() -> Iterator[None]:
    """Make too many pixels an error, and ignore warnings about odd metadata. Not for use in threads."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        yield


@contextmanager
def decoding(file: Path) -> Iterator[None]:
    """Turn the errors of decoding an image into a DatasetError, one line that names the file."""
    try:
        yield
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise DatasetError(
            f"{file}: has more pixels than Pillow's limit of {Image.MAX_IMAGE_PIXELS} lets pass; shrink it, and with "
            "it f, cx, cy and box"
        ) from None
    except UnidentifiedImageError:
        kinds = ", ".join(FORMATS)
        raise DatasetError(f"{file}: not an image of any kind that is read here ({kinds})") from None
    except BROKEN as error:
        raise DatasetError(f"{file}: cannot be read as an image ({gist(error)}); replace it") from None


def content_of(file: Path) -> bytes:
    """The bytes of an image file. Raises DatasetError if it cannot be read."""
    try:
        return read_plain(file, LARGEST_IMAGE)
    except OSError as error:
        raise DatasetError(f"{file}: cannot be read ({error.strerror})") from None


def recorded_image(path: Path, record: SampleRecord) -> Image.Image:
    """The image of a rendered sample, checked against its record and decoded.

    Raises:
        DatasetError: it cannot be read, has another checksum, or is no RGB image of the recorded size; the caller
            adds the remedy.
    """
    content = content_of(path)
    if sha256(content) != record.sha256:
        raise DatasetError(f"{path}: its checksum is not the recorded one")
    try:
        image = Image.open(io.BytesIO(content), formats=RENDERED)
        # before decoding, because a small file may expand to more pixels than memory holds
        if image.size != (record.S, record.S):
            width, height = image.size
            raise DatasetError(f"{path}: {width} x {height} pixels, {record.S} x {record.S} recorded")
        if image.mode != "RGB":
            raise DatasetError(f"{path}: its pixels are of the kind {image.mode!r}; expected RGB of 8 bits")
        image.load()
    except (*BROKEN, Image.DecompressionBombError) as error:
        raise DatasetError(f"{path}: cannot be decoded ({' '.join(str(error).split())})") from None
    return image

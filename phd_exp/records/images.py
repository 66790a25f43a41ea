"""Image files, possibly made by a stranger: decoded within limits, or refused in one line."""

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image, Jpeg2KImagePlugin, TiffImagePlugin, UnidentifiedImageError, WebPImagePlugin

from phd_exp.records.dataset import sha256
from phd_exp.records.errors import DatasetError, reading
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


@contextmanager
def pillow_warnings() -> Iterator[None]:
    """Make too many pixels an error, and ignore warnings about odd metadata. Not for use in threads."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        yield


@contextmanager
def decoding(file: Path) -> Iterator[None]:
    """Convert the errors of decoding an image, whose pixels Pillow limits, to a DatasetError that names the file."""
    with reading(file, f"expected a whole image ({', '.join(FORMATS)})", what="cannot be read as an image"):
        try:
            yield
        except UnidentifiedImageError:
            raise ValueError("of another kind") from None


def content_of(file: Path) -> bytes:
    """The bytes of an image file. Raises DatasetError if it cannot be read."""
    with reading(file):
        return read_plain(file, LARGEST_IMAGE)


def recorded_image(path: Path, record: SampleRecord) -> Image.Image:
    """The image of a rendered sample, checked against its record and decoded.

    Raises:
        DatasetError: it cannot be read, has another checksum, or is no RGB image of the recorded size; the caller
            adds the remedy.
    """
    content = content_of(path)
    with decoding(path):
        if sha256(content) != record.sha256:
            raise DatasetError(f"{path}: its checksum is not the recorded one")
        image = Image.open(io.BytesIO(content), formats=RENDERED)
        # before decoding, because a small file may expand to more pixels than memory holds
        if (*image.size, image.mode) != (record.S, record.S, "RGB"):
            raise ValueError(f"{image.size} pixels of {image.mode}; expected {record.S} x {record.S} of RGB")
        image.load()
    return image

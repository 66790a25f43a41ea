"""The images of a data set, held against their records."""

import io
from pathlib import Path

from PIL import Image

from phd_exp.records.dataset import DatasetError, sha256


def recorded_image(path: Path, checksum: str) -> Image.Image:
    """An image file, read once, checked and decoded.

    Raises:
        DatasetError: it cannot be read, is not the one recorded, or is no image; what to do is the caller's to say.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from None
    if sha256(content) != checksum:
        raise DatasetError(f"{path}: its checksum is not the recorded one")
    try:
        image = Image.open(io.BytesIO(content))
        image.load()
    except OSError as error:
        raise DatasetError(f"{path}: cannot be decoded ({error})") from None
    return image

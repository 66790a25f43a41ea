"""The images of a rendered data set: as recorded, or refused."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from phd_exp.data.cache import cached
from phd_exp.records.dataset import DatasetFolder, sha256
from phd_exp.records.errors import DatasetError
from phd_exp.records.images import recorded_image
from phd_exp.records.scenes import SampleRecord, Split

CACHE_LAYOUT = 1
"""Raised whenever the meaning of a cached array changes, so that no old one is taken for a new one."""


def cached_images(
    folder: DatasetFolder, split: Split, records: Sequence[SampleRecord], image_size: int
) -> np.ndarray:
    """The images of the records as a memory-mapped array (n, image_size, image_size, 3), uint8.

    Decodes them if no array of precisely these images is there yet. Down-sampling averages areas, so that f and
    S scale by the same factor as the image's side.

    Raises DatasetError for an image that is missing, is damaged, or cannot be decoded.
    """

    def fill(array: np.ndarray, row: int) -> None:
        record = records[row]
        array[row] = decode(folder.split_folder(split) / record.file_name, record, image_size)

    return cached(
        folder.cache / f"{split}-{len(records)}x{image_size}.npy",
        {"layout": CACHE_LAYOUT, "images": sha256("".join(record.sha256 for record in records).encode())},
        (len(records), image_size, image_size, 3),
        range(len(records)),
        fill,
        f"decoding {split} images once",
    )


def decode(file: Path, record: SampleRecord, image_size: int) -> np.ndarray:
    """One image as (image_size, image_size, 3), uint8. Raises DatasetError where the file is not as recorded."""
    try:
        image = recorded_image(file, record)
    except DatasetError as error:
        raise DatasetError(
            f"{error}; delete the file and run `python -m phd_exp render` to make it again"
        ) from None
    return shrunk(image, image_size)


def shrunk(image: Image.Image, side: int) -> np.ndarray:
    """The image as (side, side, 3), each pixel the mean of the area that it stands for."""
    if image.size != (side, side):
        image = image.resize((side, side), Image.Resampling.BOX)
    return np.asarray(image)

"""The images of a rendered data set, checked and shrunk, and where they show no object."""

from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

from phd_exp.data.cache import cached
from phd_exp.records.dataset import DatasetFolder, sha256
from phd_exp.records.errors import DatasetError
from phd_exp.records.files import checksum
from phd_exp.records.images import recorded_image
from phd_exp.records.scenes import SampleRecord, Split

if TYPE_CHECKING:
    from scipy.sparse import csr_array

SHRINKING = 2  # version of `shrunk`, recorded with each run and cache. Version 1 was exact for integer factors only.
_LARGEST_STRIPE = 1 << 22  # values converted to float64 at once


def cached_images(
    folder: DatasetFolder, split: Split, records: Sequence[SampleRecord], image_size: int
) -> np.ndarray:
    """The images of the records as a memory-mapped array (n, image_size, image_size, 3), uint8.

    Decodes them unless the cache holds exactly these images. Shrinking averages areas, so f and S scale by the same
    factor as the side of the image.

    Raises DatasetError for an image that is missing, damaged, or cannot be decoded.
    """

    def fill(array: np.ndarray, row: int) -> None:
        record = records[row]
        try:
            image = recorded_image(folder.split_folder(split) / record.file_name, record)
        except DatasetError as error:
            remedy = "delete the file and run `python -m phd_exp render` to make it again"
            raise DatasetError(f"{error}; {remedy}") from None
        array[row] = shrunk(np.asarray(image), image_size)

    n, file = len(records), folder.cache / f"{split}-{len(records)}x{image_size}.npy"
    key = {"shrinking": SHRINKING, "images": sha256("".join(record.sha256 for record in records).encode())}
    return cached(file, key, (n, image_size, image_size, 3), range(n), fill, f"decoding {split} images once")


def cached_clearings(folder: DatasetFolder, n: int, image_size: int) -> np.ndarray:
    """The share of each pixel of the first n training images that shows no object, 0 to 255.

    Memory-mapped (n, image_size, image_size), uint8. Raises DatasetError if the renderer has not drawn them.
    """
    bits = folder.drawn("clearings.npy", n)

    def fill(array: np.ndarray, row: int) -> None:
        clear = np.uint8(255) * np.unpackbits(bits[row], axis=-1, count=bits.shape[1])
        array[row] = shrunk(clear[..., None], image_size)[..., 0]

    file = folder.cache / f"train-{n}x{image_size}-clear.npy"
    key = {"shrinking": SHRINKING, "clearings": checksum(folder.root / "clearings.npy")}
    return cached(file, key, (n, image_size, image_size), range(n), fill, "decoding train backdrops once")


def shrunk(pixels: UInt8[np.ndarray, "height width bands"], side: int) -> UInt8[np.ndarray, "side side bands"]:
    """The image with `side` x `side` pixels, each the rounded mean of the area that it covers.

        out[i, j] = sum_(y, x) H[i, y] W[j, x] pixels[y, x] / (height width)

    H and W are the overlaps of `_overlaps`. The sums are exact integers, so mirrored images give mirrored results.

    Examples:
        >>> pixels = np.arange(16, dtype=np.uint8).reshape(4, 4, 1).repeat(3, axis=2)
        >>> shrunk(pixels, 2)[..., 0].tolist()
        [[2, 4], [10, 12]]
    """
    height, width, bands = pixels.shape
    if (height, width) == (side, side):
        return pixels
    H, W = _overlaps(height, side), _overlaps(width, side)
    step = max(1, side * _LARGEST_STRIPE // pixels.size)  # rows at once: bounds the memory
    out = np.empty((side, side, bands), dtype=np.uint8)
    for first in range(0, side, step):
        last = min(first + step, side)
        top, bottom = first * height // side, -(-last * height // side)
        across = H[first:last, top:bottom] @ pixels[top:bottom].reshape(bottom - top, -1)
        across = across.reshape(-1, width, bands).swapaxes(0, 1).reshape(width, -1)
        sums = (W @ across).reshape(side, -1, bands).swapaxes(0, 1)
        out[first:last] = np.rint(sums / (height * width))
    return out


@lru_cache(maxsize=16)
def _overlaps(n: int, side: int) -> "csr_array":
    """Overlap of output pixel i with input pixel x, in units of 1/side input pixels; each row sums to n."""
    from scipy.sparse import csr_array  # imported slowly, and images of the network's size do not need it

    i, x = np.arange(side)[:, None], np.arange(n)
    length = np.minimum((i + 1) * n, (x + 1) * side) - np.maximum(i * n, x * side)
    return csr_array(length.clip(0).astype(float))

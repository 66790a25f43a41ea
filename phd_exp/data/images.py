"""The images of a rendered data set, checked and shrunk, and masks of where they show the object."""

from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
from jaxtyping import UInt8
from scipy.sparse import csr_array

from phd_exp.data.cache import cached
from phd_exp.records.dataset import DatasetFolder, sha256
from phd_exp.records.errors import DatasetError
from phd_exp.records.images import recorded_image
from phd_exp.records.scenes import SampleRecord, Split
from phd_exp.rendering.rays import NOTHING, cylinder_mask, trace_pixels
from phd_exp.rendering.triangles import Meshes

SHRINKING = 2  # version of `shrunk`, recorded with each run and cache. Version 1 was exact for integer factors only.
_LARGEST_STRIPE = 1 << 22  # values converted to float64 at once
CELLS = 28  # cells along each side of a mask: 8 x 8 pixels of a render of 224
RAYS = 4  # along each side of a cell
DRAWING = 1  # version of `mask`, recorded with each cache


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
    key = {"shrinking": SHRINKING, "images": _checksum(records)}
    return cached(file, key, (n, image_size, image_size, 3), range(n), fill, f"decoding {split} images once")


def cached_masks(
    folder: DatasetFolder, split: Split, records: Sequence[SampleRecord], meshes: Callable[[], Meshes]
) -> np.ndarray:
    """The masks of the records as a memory-mapped array (n, CELLS, CELLS), uint8; see `mask`.

    `meshes` is called for every mask that is drawn: it starts Blender the first time, which takes seconds.
    """

    def fill(array: np.ndarray, row: int) -> None:
        array[row] = mask(records[row], meshes())

    n, file = len(records), folder.cache / f"{split}-{len(records)}-masks.npy"
    key = {"masks": DRAWING, "images": _checksum(records)}
    return cached(file, key, (n, CELLS, CELLS), range(n), fill, f"drawing {split} masks once")


def cached_clearings(
    folder: DatasetFolder,
    split: Split,
    records: Sequence[SampleRecord],
    meshes: Callable[[], Meshes],
    image_size: int,
) -> np.ndarray:
    """The share of each pixel of the images that shows no object, 0 to 255: (n, image_size, image_size), uint8.

    `meshes` as for `cached_masks`.
    """

    def fill(array: np.ndarray, row: int) -> None:
        clear = trace_pixels(records[row].shown, meshes()).first == NOTHING
        array[row] = shrunk(np.repeat(255 * clear[..., None].astype(np.uint8), 3, axis=-1), image_size)[..., 0]

    n, file = len(records), folder.cache / f"{split}-{len(records)}x{image_size}-clear.npy"
    key = {"shrinking": SHRINKING, "masks": DRAWING, "images": _checksum(records)}
    return cached(file, key, (n, image_size, image_size), range(n), fill, f"drawing {split} backdrops once")


def _checksum(records: Sequence[SampleRecord]) -> str:
    return sha256("".join(record.sha256 for record in records).encode())


def mask(record: SampleRecord, meshes: Meshes) -> np.ndarray:
    """The share of each cell of the image that shows the object, from 0 to 255: (CELLS, CELLS), uint8."""
    side = CELLS * RAYS
    scene = record.shown.model_copy(update={"S": side, "f": record.f * side / record.S})
    shown = cylinder_mask(trace_pixels(scene, meshes))
    share = shown.reshape(CELLS, RAYS, CELLS, RAYS).mean((1, 3))
    return np.rint(255 * share).astype(np.uint8)


def shrunk(pixels: UInt8[np.ndarray, "height width 3"], side: int) -> UInt8[np.ndarray, "side side 3"]:
    """The image with `side` x `side` pixels, each the rounded mean of the area that it covers.

        out[i, j] = sum_(y, x) H[i, y] W[j, x] pixels[y, x] / (height width)

    H and W are the overlaps of `_overlaps`. The sums are exact integers, so mirrored images give mirrored results.

    Examples:
        >>> pixels = np.arange(16, dtype=np.uint8).reshape(4, 4, 1).repeat(3, axis=2)
        >>> shrunk(pixels, 2)[..., 0].tolist()
        [[2, 4], [10, 12]]
    """
    height, width, _ = pixels.shape
    if (height, width) == (side, side):
        return pixels
    H, W = _overlaps(height, side), _overlaps(width, side)
    step = max(1, side * _LARGEST_STRIPE // pixels.size)  # rows at once: bounds the memory
    out = np.empty((side, side, 3), dtype=np.uint8)
    for first in range(0, side, step):
        last = min(first + step, side)
        top, bottom = first * height // side, -(-last * height // side)
        across = H[first:last, top:bottom] @ pixels[top:bottom].reshape(bottom - top, -1)
        across = across.reshape(-1, width, 3).swapaxes(0, 1).reshape(width, -1)
        sums = (W @ across).reshape(side, -1, 3).swapaxes(0, 1)
        out[first:last] = np.rint(sums / (height * width))
    return out


@lru_cache(maxsize=16)
def _overlaps(n: int, side: int) -> csr_array:
    """Overlap of output pixel i with input pixel x, in units of 1/side input pixels; each row sums to n."""
    first = np.arange(side) * n // side
    x = first[:, None] + np.arange(n // side + 2)
    i = np.arange(side)[:, None]
    length = np.minimum((i + 1) * n, (x + 1) * side) - np.maximum(i * n, x * side)
    kept = length > 0
    rows = np.broadcast_to(i, x.shape)[kept]
    return csr_array((length[kept].astype(float), (rows, x[kept])), shape=(side, n))

"""Where the object is visible, from the geometry of the scenes: labels of the training samples of rendered data."""

from collections.abc import Sequence

import numpy as np

from phd_exp.data.cache import cached
from phd_exp.records.dataset import DatasetFolder, sha256
from phd_exp.records.scenes import SampleRecord, Split
from phd_exp.rendering.rays import cylinder_mask, trace_pixels
from phd_exp.rendering.triangles import Meshes

CELLS = 28  # cells along each side of a mask: 8 x 8 pixels of a render of 224
RAYS = 4  # along each side of a cell
VERSION = 1  # of `mask`, recorded with each cache


def cached_masks(folder: DatasetFolder, split: Split, records: Sequence[SampleRecord], meshes: Meshes) -> np.ndarray:
    """The masks of the records as a memory-mapped array (n, CELLS, CELLS), uint8; see `mask`."""

    def fill(array: np.ndarray, row: int) -> None:
        array[row] = mask(records[row], meshes)

    n, file = len(records), folder.cache / f"{split}-{len(records)}-masks.npy"
    key = {"masks": VERSION, "images": sha256("".join(record.sha256 for record in records).encode())}
    return cached(file, key, (n, CELLS, CELLS), range(n), fill, f"drawing {split} masks once")


def mask(record: SampleRecord, meshes: Meshes) -> np.ndarray:
    """The share of each cell of the image that shows the object, from 0 to 255: (CELLS, CELLS), uint8."""
    side = CELLS * RAYS
    scene = record.shown.model_copy(update={"S": side, "f": record.f * side / record.S})
    shown = cylinder_mask(trace_pixels(scene, meshes))
    share = shown.reshape(CELLS, RAYS, CELLS, RAYS).mean((1, 3))
    return np.rint(255 * share).astype(np.uint8)

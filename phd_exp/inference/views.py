"""The input image of a network, seen by a virtual camera, and what a caller from Python gives for it."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import UInt8
from torch import Tensor

from phd_exp.optics.virtual import Box, VirtualCamera
from phd_exp.records.errors import DatasetError, shown


@dataclass(frozen=True, eq=False)
class View:
    """The input image of a network, prepared as in training, and its virtual camera, whose frame predictions have.

    Args:
        image: RGB.
        camera: turned towards the box.
        box: the part of the photograph that is predicted from, px.
        size: width and height of the photograph, px.
        where: the place of the photograph, for messages.
    """

    image: UInt8[np.ndarray, "S S 3"]
    camera: VirtualCamera
    box: Box
    size: tuple[int, int]
    where: str = "image"


def image_batch(images: Any) -> UInt8[np.ndarray, "batch height width 3"]:
    """RGB images of 8 bits as one array, a single one as a batch. Raises DatasetError for anything else."""
    array = images.detach().cpu().numpy() if isinstance(images, Tensor) else np.asarray(images)
    array = array[None] if array.ndim == 3 else array
    if array.dtype != np.uint8 or array.ndim != 4 or array.shape[-1] != 3 or 0 in array.shape:
        raise DatasetError(
            f"images: got {array.dtype} of shape {array.shape}; expected uint8 of shape (n, height, width, 3), RGB"
        )
    return np.ascontiguousarray(array)


def focal_lengths(f: Any, n: int) -> list[float]:
    """One focal length, pixels, for each of n images. Raises DatasetError unless they are positive and finite."""
    try:
        values = np.asarray(f.detach().cpu() if isinstance(f, Tensor) else f, dtype=float).ravel()
        values = np.broadcast_to(values, (n,))
    except (ValueError, TypeError):
        values = np.full(1, np.nan)
    if not (np.isfinite(values).all() and (values > 0).all()):
        raise DatasetError(
            f"f: got {shown(f)}; expected a focal length in pixels, positive: one, or one for each of {n} images"
        )
    return [float(value) for value in values]

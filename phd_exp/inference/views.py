"""The input image of a network: a box of a photograph, or a whole image, seen by a virtual camera."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from phd_exp.data.crops import cut
from phd_exp.geometry.virtual import Box, VirtualCamera
from phd_exp.records.errors import DatasetError, shown


@dataclass(frozen=True, eq=False)
class View:
    """The input image of a network, prepared as in training, and its virtual camera, whose frame predictions have.

    Examples:
        >>> from phd_exp.geometry import intrinsics
        >>> photo, K = Image.new("RGB", (90, 60)), intrinsics(300.0, 300.0, 45.0, 30.0)
        >>> View.of_box(photo, K, (50.0, 10.0, 80.0, 50.0), side=32, where="photo").image.shape
        (32, 32, 3)
    """

    image: UInt8[np.ndarray, "S S 3"]
    camera: VirtualCamera

    @classmethod
    def of_box(
        cls,
        image: Image.Image,
        K: Float[np.ndarray, "3 3"],
        box: Box | None,
        side: int,
        where: str,
        largest_f: float = np.inf,
    ) -> "View":
        """The view of a box in an RGB image (None: all of it), `side` pixels a side.

        A small box is viewed with a focal length of `largest_f` pixels, and the pixels around it.

        Raises DatasetError, naming `where`, if the box is too wide.
        """
        left, top, right, bottom = map(float, (0, 0, *image.size) if box is None else box)
        largest_f = np.inf if box is None else largest_f
        try:
            camera = VirtualCamera.of_box(K, (left, top, right, bottom), float(side), largest_f=largest_f)
        except ValueError as error:
            raise DatasetError(f"{where}: {error}") from None
        return cls(cut(image, camera), camera)

    @property
    def is_turned(self) -> bool:
        """Whether the frame of the virtual camera differs from that of the real camera."""
        return not np.array_equal(self.camera.R, np.eye(3))


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

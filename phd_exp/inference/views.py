"""The network's view of an image of any size, prepared as in training."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from phd_exp.data.crops import cut
from phd_exp.geometry.virtual import Box, VirtualCamera
from phd_exp.records.errors import DatasetError


@dataclass(frozen=True, eq=False)
class View:
    """The input image of a network and its virtual camera; predictions are in the frame of that camera."""

    image: UInt8[np.ndarray, "S S 3"]
    camera: VirtualCamera

    @classmethod
    def of_box(
        cls, image: Image.Image, K: Float[np.ndarray, "3 3"], box: Box, side: int, where: str
    ) -> "View":
        """The view of a box in an RGB image, `side` pixels a side.

        Raises DatasetError, naming `where`, if the box is too wide.
        """
        try:
            camera = VirtualCamera.of_box(K, box, float(side))
        except ValueError as error:
            raise DatasetError(f"{where}: box={list(box)}: {error}") from None
        return cls(cut(image, camera), camera)

    @property
    def is_turned(self) -> bool:
        """Whether the frame of the virtual camera differs from that of the real camera."""
        return not np.array_equal(self.camera.R, np.eye(3))

"""From an image of any size to what a network sees of it, prepared as its training prepared its images."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from phd_exp.data.crops import cut
from phd_exp.data.images import shrunk
from phd_exp.geometry.virtual import Box, VirtualCamera
from phd_exp.records.errors import DatasetError


@dataclass(frozen=True, eq=False)
class View:
    """What a network sees, and the virtual camera that sees it so; positions are in that camera's frame."""

    image: UInt8[np.ndarray, "S S 3"]
    camera: VirtualCamera

    @property
    def is_turned(self) -> bool:
        """Whether the virtual camera's frame is another than that of the real one."""
        return not np.array_equal(self.camera.R, np.eye(3))


@dataclass(frozen=True)
class Preparation:
    """How a run prepared its images.

    Args:
        side: of the network's image, pixels.
        shrinks: whether square images seen as a whole were shrunk by averaging areas, as those of rendered data sets
            are; images of one's own always go through `cut`.
    """

    side: int
    shrinks: bool

    def view(self, image: Image.Image, K: Float[np.ndarray, "3 3"], box: Box, where: str) -> View:
        """What the network sees of a box in an RGB image. Raises DatasetError, naming `where`, for too wide a box."""
        try:
            camera = VirtualCamera.of_box(K, box, float(self.side))
        except ValueError as error:
            raise DatasetError(f"{where}: box={list(box)}: {error}") from None
        if self.shrinks and _is_whole(image, K, box) and image.width >= self.side:
            return View(shrunk(image, self.side), camera)
        return View(cut(image, camera), camera)


def _is_whole(image: Image.Image, K: Float[np.ndarray, "3 3"], box: Box) -> bool:
    """Whether the virtual image is a square image itself: all of it, the principal point in its middle."""
    side = image.width
    whole = image.size == (side, side) and box == (0.0, 0.0, side, side)
    return whole and K[0, 0] == K[1, 1] and K[0, 2] == K[1, 2] == side / 2

"""The pinhole camera: positions in the camera frame <-> pixels of a square image, and grids over an image."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class Camera:
    """A batch of pinhole cameras with square images, the principal point in the middle and no distortion.

    Positions and pixels may have any batch shape that broadcasts with that of f. For several points per camera,
    f needs a trailing dimension of one.

    Args:
        f: focal lengths, pixels; one per element of the batch (no dimensions for a single camera).
        S: side of the image, pixels; the same for the whole batch.

    Raises ValueError if f or S is not positive or not finite.

    Examples:
        >>> Camera(torch.tensor(1500.0), S=224.0).project(torch.tensor([0.28, 0.0, 4.0]))
        tensor([217., 112.])
    """

    f: Float[Tensor, "*batch"]
    S: float

    def __post_init__(self) -> None:
        """Check f and S."""
        if not (math.isfinite(self.S) and self.S > 0):
            raise ValueError(f"S, the side of the image in pixels, must be positive and finite, but is {self.S}")
        if torch.compiler.is_compiling():  # a graph cannot refuse values
            return
        valid = (self.f > 0) & self.f.isfinite()
        if not bool(valid.all()):
            raise ValueError(
                "f, the focal length in pixels, must be positive and finite, "
                f"but {int((~valid).sum())} of {valid.numel()} are not, the first of them {self.f[~valid][0].item()}"
            )

    @classmethod
    def unchecked(cls, f: Float[Tensor, "*batch"], S: float) -> "Camera":
        """Cameras from values that were checked before, without reading f, for which a GPU would wait."""
        camera = object.__new__(cls)
        vars(camera).update(f=f, S=S)
        return camera

    def project(self, xyz: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch 2"]:
        """Pixel of a position: (u, v) = f (x, y)/z + S/2; meaningless for z <= 0.

        Source: the pinhole model; pixel centres at (column + 0.5, row + 0.5).
        """
        return self.f[..., None] * xyz[..., :2] / xyz[..., 2:] + self.S / 2

    def unproject(self, pixel: Float[Tensor, "*#batch 2"], z: Float[Tensor, "*#batch"]) -> Float[Tensor, "*#batch 3"]:
        """Position at depth z (metres) that projects to a pixel: ((u, v) - S/2) z/f, z."""
        return at_depth((pixel - self.S / 2) / self.f[..., None], z)

    def contains(self, xyz: Float[Tensor, "*#batch 3"]) -> Bool[Tensor, "*#batch"]:
        """Whether a position lies in the field of view: in front of the camera and inside the image."""
        # |f x| <= z S/2 avoids the division by a depth that may be zero
        inside = (self.f[..., None] * xyz[..., :2]).abs() <= xyz[..., 2:] * (self.S / 2)
        return inside.all(dim=-1) & (xyz[..., 2] > 0)

    def with_constant_f(self, constant_f: float | None) -> "Camera":
        """The cameras with one focal length (pixels) for all; None keeps their own."""
        return self if constant_f is None else Camera.unchecked(torch.full_like(self.f, constant_f), self.S)


def at_depth(xy_over_z: Float[Tensor, "*#batch 2"], z: Float[Tensor, "*#batch"]) -> Float[Tensor, "*#batch 3"]:
    """Position (x, y, z) at depth z (metres), given (x, y)/z."""
    return torch.cat([xy_over_z, torch.ones_like(xy_over_z[..., :1])], dim=-1) * z[..., None]


def middles(rows: int, columns: int) -> Float[Tensor, "rows columns 2"]:
    """Middles (x, y) of the cells of a grid over an image, from -1 to 1 as the projected position."""
    y, x = ((2 * torch.arange(n) + 1) / n - 1 for n in (rows, columns))
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)

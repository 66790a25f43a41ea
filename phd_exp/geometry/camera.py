"""The pinhole camera: positions in the camera frame <-> pixels of a square image."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class Camera:
    """A batch of pinhole cameras with square images, the principal point in the middle and no distortion.

    Args:
        f: focal lengths, pixels; one per element of the batch (no dimensions for a single camera).
        S: side of the image, pixels; the same for the whole batch.

    Positions and pixels may have any batch shape that broadcasts with that of f. For several points per camera,
    give f a trailing dimension of one.

    Raises:
        ValueError: f or S is not positive or not finite.
    """

    f: Float[Tensor, "*batch"]
    S: float

    def __post_init__(self) -> None:
        """Refuse a camera that cannot form an image."""
        if not (math.isfinite(self.S) and self.S > 0):
            raise ValueError(
                f"S, the side of the image in pixels, must be positive and finite, but is {self.S}"
            )
        if torch.compiler.is_compiling():  # a graph cannot refuse values
            return
        valid = (self.f > 0) & self.f.isfinite()
        if not bool(valid.all()):
            raise ValueError(
                "f, the focal length in pixels, must be positive and finite, "
                f"but {int((~valid).sum())} of {valid.numel()} are not, the first of them {self.f[~valid][0].item()}"
            )

    def project(self, xyz: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch 2"]:
        """Pixel in which a position is seen: (u, v) = f (x, y)/z + S/2; meaningless for z <= 0.

        Source: the pinhole model; pixel centres at (column + 0.5, row + 0.5).
        """
        return self.f[..., None] * xyz[..., :2] / xyz[..., 2:] + self.S / 2

    def unproject(
        self, pixel: Float[Tensor, "*#batch 2"], z: Float[Tensor, "*#batch"]
    ) -> Float[Tensor, "*#batch 3"]:
        """Position at depth z (metres) that is seen in a pixel: ((u, v) - S/2) z/f, z."""
        xy_over_z = (pixel - self.S / 2) / self.f[..., None]
        direction = torch.cat([xy_over_z, torch.ones_like(xy_over_z[..., :1])], dim=-1)
        return direction * z[..., None]

    def ray(self, pixel: Float[Tensor, "*#batch 2"]) -> Float[Tensor, "*#batch 3"]:
        """Unit vector from the camera towards what is seen in a pixel."""
        return torch.nn.functional.normalize(self.unproject(pixel, torch.ones_like(pixel[..., 0])), dim=-1)

    def contains(self, xyz: Float[Tensor, "*#batch 3"]) -> Bool[Tensor, "*#batch"]:
        """Whether a position lies in the field of view: in front of the camera and inside the image."""
        # |f x| <= z S/2 says both at once, and needs no division by a depth that may be zero
        inside = (self.f[..., None] * xyz[..., :2]).abs() <= xyz[..., 2:] * (self.S / 2)
        return inside.all(dim=-1) & (xyz[..., 2] > 0)

    def scaled(self, factor: float) -> "Camera":
        """The camera of the same image resized by a factor: f and S grow together.

        Raises:
            ValueError: the factor is not positive or not finite.
        """
        if not (math.isfinite(factor) and factor > 0):
            raise ValueError(f"factor must be positive and finite, but is {factor}")
        return Camera(self.f * factor, self.S * factor)

    def with_constant_f(self, constant_f: float | None) -> "Camera":
        """The cameras as a network knows them that is told one focal length for all; None tells it the true ones.

        Args:
            constant_f: pixels.

        Raises:
            ValueError: the focal length is not positive or not finite.
        """
        return self if constant_f is None else Camera(torch.full_like(self.f, constant_f), self.S)

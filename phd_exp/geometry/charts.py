"""Charts: smooth one-to-one maps from positions in front of a camera to the coordinates that a network regresses.

Source: paper, sections "Parameter remapping" (v_p, z_p) and "Experimental result" (the baselines).
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.geometry.camera import Camera, at_depth


@dataclass(frozen=True)
class DepthScale:
    """The constants of a data set that scale its depths to order one.

    Args:
        mu_z0: geometric middle of z/f over the data set, sqrt(max(z/f) min(z/f)); metres per pixel.
        D: half the range of z/f, sqrt(max(z/f) / min(z/f)); at least 1.
        z_centre: middle of the range of z, metres.

    Raises ValueError if mu_z0 or z_centre is not positive and finite, or D not in [1, inf).

    Source: paper, section "Parameter remapping".

    Examples:
        >>> DepthScale.from_ranges(f_range=(1000.0, 2000.0), z_range=(2.0, 4.0))
        DepthScale(mu_z0=0.002, D=2.0, z_centre=3.0)
    """

    mu_z0: float
    D: float
    z_centre: float

    def __post_init__(self) -> None:
        """Check the constants."""
        for name in ("mu_z0", "z_centre"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be positive and finite, but is {value}")
        if not (math.isfinite(self.D) and self.D >= 1):
            raise ValueError(f"D must be at least 1 and finite, but is {self.D}")

    @classmethod
    def from_ranges(cls, f_range: tuple[float, float], z_range: tuple[float, float]) -> "DepthScale":
        """The constants of a data set whose f (pixels) and z (metres) fill two independent ranges.

        Raises ValueError if a range is not (low, high) with 0 < low <= high < inf.
        """
        for name, (low, high) in (("f_range", f_range), ("z_range", z_range)):
            if not 0 < low <= high < math.inf:
                raise ValueError(f"{name} must be (low, high) with 0 < low <= high < inf, but is {(low, high)}")
        return cls._from_extremes(z_range[0] / f_range[1], z_range[1] / f_range[0], *z_range)

    @classmethod
    def from_samples(cls, z: Float[Tensor, " samples"], f: Float[Tensor, " samples"]) -> "DepthScale":
        """The constants of a data set, at least one sample, with these depths (metres) and focal lengths (pixels)."""
        extremes = (*torch.aminmax((z / f).double()), *torch.aminmax(z))
        return cls._from_extremes(*(value.item() for value in extremes))

    @classmethod
    def _from_extremes(cls, nearest: float, farthest: float, low: float, high: float) -> "DepthScale":
        """From the extremes of z/f and of z."""
        return cls(math.sqrt(farthest * nearest), math.sqrt(farthest / nearest), z_centre=(low + high) / 2)

    def scaled(self, factor: float) -> "DepthScale":
        """The constants of the same data set with images resized by a factor, which divides z/f."""
        return DepthScale(self.mu_z0 / factor, self.D, self.z_centre)


def projected(xyz: Float[Tensor, "*#batch 3"], camera: Camera) -> Float[Tensor, "*#batch 2"]:
    """Projected position v_p = 2 f (x, y) / (S z), in [-1, 1] inside the image.

    Source: paper, section "Parameter remapping".
    """
    return 2 * camera.f[..., None] * xyz[..., :2] / (camera.S * xyz[..., 2:])


def compensated_depth(xyz: Float[Tensor, "*#batch 3"], camera: Camera, mu_z0: float) -> Float[Tensor, "*#batch"]:
    """Depth compensated for the focal length, z_p = z / (mu_z0 f), in [1/D, D] over the data set.

    Source: paper, section "Parameter remapping".
    """
    return xyz[..., 2] / (mu_z0 * camera.f)


def _position(
    v_p: Float[Tensor, "*#batch 2"], z: Float[Tensor, "*#batch"], camera: Camera
) -> Float[Tensor, "*#batch 3"]:
    """Position at depth z with the given projected position, (x, y) = v_p S z / (2 f)."""
    return at_depth(v_p * camera.S / (2 * camera.f[..., None]), z)


def _log_abs_det_projected(xyz: Float[Tensor, "*#batch 3"], camera: Camera) -> Float[Tensor, "*#batch"]:
    """log|d v_p / d (x, y)| = 2 log(2 f / (S z))."""
    return 2 * torch.log(2 * camera.f / (camera.S * xyz[..., 2]))


class Chart(ABC):
    """Three coordinates of positions z > 0 in front of a camera, of order one over the data set.

    Attributes:
        has_projection: whether the first two coordinates are the projected position v_p.
    """

    has_projection: ClassVar[bool] = True

    @abstractmethod
    def coordinates(self, xyz: Float[Tensor, "*#batch 3"], camera: Camera) -> Float[Tensor, "*#batch 3"]:
        """The coordinates of a position (metres)."""

    @abstractmethod
    def position(self, coordinates: Float[Tensor, "*#batch 3"], camera: Camera) -> Float[Tensor, "*#batch 3"]:
        """The position (metres) with these coordinates; the inverse of `coordinates`."""

    @abstractmethod
    def log_abs_det_jacobian(self, xyz: Float[Tensor, "*#batch 3"], camera: Camera) -> Float[Tensor, "*#batch"]:
        """log|det d coordinates / d xyz| at a position, the difference of log densities in the two frames."""


@dataclass(frozen=True)
class Projected(Chart):
    """Projected position and compensated depth: (v_p, z_p - 1).

    Source: paper, baseline "MAE v, z".
    """

    depth: DepthScale

    def coordinates(self, xyz: Float[Tensor, "*#batch 3"], camera: Camera) -> Float[Tensor, "*#batch 3"]:
        z_p = compensated_depth(xyz, camera, self.depth.mu_z0)
        return torch.cat([projected(xyz, camera), z_p[..., None] - 1], dim=-1)

    def position(self, coordinates: Float[Tensor, "*#batch 3"], camera: Camera) -> Float[Tensor, "*#batch 3"]:
        return _position(coordinates[..., :2], (coordinates[..., 2] + 1) * self.depth.mu_z0 * camera.f, camera)

    def log_abs_det_jacobian(self, xyz: Float[Tensor, "*#batch 3"], camera: Camera) -> Float[Tensor, "*#batch"]:
        return _log_abs_det_projected(xyz, camera) - torch.log(self.depth.mu_z0 * camera.f)


@dataclass(frozen=True)
class LogDepth(Chart):
    """Projected position and the logarithm of compensated depth: (v_p, log(z_p) / D).

    Source: paper, baseline "MAE v, log z".
    """

    depth: DepthScale

    def coordinates(self, xyz: Float[Tensor, "*#batch 3"], camera: Camera) -> Float[Tensor, "*#batch 3"]:
        z_p = compensated_depth(xyz, camera, self.depth.mu_z0)
        return torch.cat([projected(xyz, camera), z_p[..., None].log() / self.depth.D], dim=-1)

    def position(self, coordinates: Float[Tensor, "*#batch 3"], camera: Camera) -> Float[Tensor, "*#batch 3"]:
        z = torch.exp(self.depth.D * coordinates[..., 2]) * self.depth.mu_z0 * camera.f
        return _position(coordinates[..., :2], z, camera)

    def log_abs_det_jacobian(self, xyz: Float[Tensor, "*#batch 3"], camera: Camera) -> Float[Tensor, "*#batch"]:
        return _log_abs_det_projected(xyz, camera) - torch.log(self.depth.D * xyz[..., 2])


@dataclass(frozen=True)
class Cartesian(Chart):
    """The shifted and scaled position (x / xy_unit, y / xy_unit, z - z_centre), which does not depend on f.

    Args:
        depth: the data set's constants, which provide z_centre.
        xy_unit: length of the unit of x and y, metres.

    Source: paper, baseline "MAE x, y, z".
    """

    has_projection: ClassVar[bool] = False
    depth: DepthScale
    xy_unit: float = 0.25

    def coordinates(self, xyz: Float[Tensor, "*#batch 3"], camera: Camera) -> Float[Tensor, "*#batch 3"]:
        return torch.cat([xyz[..., :2] / self.xy_unit, xyz[..., 2:] - self.depth.z_centre], dim=-1)

    def position(self, coordinates: Float[Tensor, "*#batch 3"], camera: Camera) -> Float[Tensor, "*#batch 3"]:
        return torch.cat([coordinates[..., :2] * self.xy_unit, coordinates[..., 2:] + self.depth.z_centre], dim=-1)

    def log_abs_det_jacobian(self, xyz: Float[Tensor, "*#batch 3"], camera: Camera) -> Float[Tensor, "*#batch"]:
        return torch.full_like(xyz[..., 2], -2 * math.log(self.xy_unit))

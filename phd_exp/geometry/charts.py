"""Charts: one-to-one smooth maps between positions in front of a camera and the coordinates a network regresses.

Source: paper, sections "Parameter remapping" (v_p, z_p) and "Experimental result" (the baselines).
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.geometry.camera import Camera


@dataclass(frozen=True)
class DepthScale:
    """The constants of a data set that bring its depths to order one.

    Args:
        mu_z0: geometric middle of z/f over the data set, sqrt(max(z/f) min(z/f)); metres per pixel.
        D: half the range of z/f, sqrt(max(z/f) / min(z/f)); at least 1.
        z_centre: middle of the range of z, metres.

    Raises:
        ValueError: mu_z0 or z_centre is not positive and finite, or D not in [1, inf).

    Source: paper, section "Parameter remapping".
    """

    mu_z0: float
    D: float
    z_centre: float

    def __post_init__(self) -> None:
        """Refuse constants that no data set in front of a camera has."""
        for name in ("mu_z0", "z_centre"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be positive and finite, but is {value}")
        if not (math.isfinite(self.D) and self.D >= 1):
            raise ValueError(f"D must be at least 1 and finite, but is {self.D}")

    @classmethod
    def from_ranges(cls, f_range: tuple[float, float], z_range: tuple[float, float]) -> "DepthScale":
        """The constants of a data set with all f (pixels) and z (metres) of two independent ranges.

        Raises:
            ValueError: a range is not (low, high) with 0 < low <= high < inf.
        """
        for name, (low, high) in (("f_range", f_range), ("z_range", z_range)):
            if not 0 < low <= high < math.inf:
                raise ValueError(
                    f"{name} must be (low, high) with 0 < low <= high < inf, but is {(low, high)}"
                )
        nearest, farthest = z_range[0] / f_range[1], z_range[1] / f_range[0]
        return cls(
            mu_z0=math.sqrt(farthest * nearest),
            D=math.sqrt(farthest / nearest),
            z_centre=(z_range[0] + z_range[1]) / 2,
        )

    @classmethod
    def from_samples(cls, z: Float[Tensor, " samples"], f: Float[Tensor, " samples"]) -> "DepthScale":
        """The constants of a data set given by its depths (metres) and focal lengths (pixels).

        Raises:
            ValueError: there are no samples, or some z or f is not positive.
        """
        if z.numel() == 0:
            raise ValueError("z and f must hold at least one sample, but are empty")
        for name, value in (("z", z), ("f", f)):
            if not bool((value > 0).all()):
                raise ValueError(f"{name} must be positive, but its smallest value is {value.min().item()}")
        nearest, farthest = torch.aminmax((z / f).double())
        return cls(
            mu_z0=math.sqrt(farthest.item() * nearest.item()),
            D=math.sqrt(farthest.item() / nearest.item()),
            z_centre=(z.min().item() + z.max().item()) / 2,
        )

    def scaled(self, factor: float) -> "DepthScale":
        """The constants of the same data set with its images resized by a factor: f grows, z/f shrinks."""
        return DepthScale(self.mu_z0 / factor, self.D, self.z_centre)


def projected(xyz: Float[Tensor, "*#batch 3"], camera: Camera) -> Float[Tensor, "*#batch 2"]:
    """Projected position v_p = 2 f (x, y) / (S z), in [-1, 1] inside the image.

    Source: paper, section "Parameter remapping".
    """
    return 2 * camera.f[..., None] * xyz[..., :2] / (camera.S * xyz[..., 2:])


def compensated_depth(
    xyz: Float[Tensor, "*#batch 3"], camera: Camera, mu_z0: float
) -> Float[Tensor, "*#batch"]:
    """Depth compensated for the focal length, z_p = z / (mu_z0 f), in [1/D, D] over the data set.

    Source: paper, section "Parameter remapping".
    """
    return xyz[..., 2] / (mu_z0 * camera.f)


def _position(
    v_p: Float[Tensor, "*#batch 2"], z: Float[Tensor, "*#batch"], camera: Camera
) -> Float[Tensor, "*#batch 3"]:
    """Position at depth z with the given projected position, (x, y) = v_p S z / (2 f)."""
    xy_over_z = v_p * camera.S / (2 * camera.f[..., None])
    direction = torch.cat([xy_over_z, torch.ones_like(xy_over_z[..., :1])], dim=-1)
    return direction * z[..., None]


def _log_abs_det_projected(xyz: Float[Tensor, "*#batch 3"], camera: Camera) -> Float[Tensor, "*#batch"]:
    """log|d v_p / d (x, y)| = 2 log(2 f / (S z))."""
    return 2 * torch.log(2 * camera.f / (camera.S * xyz[..., 2]))


class Chart(ABC):
    """Three coordinates for positions z > 0 in front of a camera, of order one over the data set.

    Attributes:
        has_projection: whether the first two are the projected position v_p.
    """

    has_projection: ClassVar[bool] = True

    @abstractmethod
    def coordinates(self, xyz: Float[Tensor, "*#batch 3"], camera: Camera) -> Float[Tensor, "*#batch 3"]:
        """The coordinates of a position (metres)."""

    @abstractmethod
    def position(self, coordinates: Float[Tensor, "*#batch 3"], camera: Camera) -> Float[Tensor, "*#batch 3"]:
        """The position (metres) with these coordinates; the inverse of `coordinates`."""

    @abstractmethod
    def log_abs_det_jacobian(
        self, xyz: Float[Tensor, "*#batch 3"], camera: Camera
    ) -> Float[Tensor, "*#batch"]:
        """log|det d coordinates / d xyz| at a position, by which log densities in the two frames differ."""


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
        return _position(
            coordinates[..., :2], (coordinates[..., 2] + 1) * self.depth.mu_z0 * camera.f, camera
        )

    def log_abs_det_jacobian(
        self, xyz: Float[Tensor, "*#batch 3"], camera: Camera
    ) -> Float[Tensor, "*#batch"]:
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

    def log_abs_det_jacobian(
        self, xyz: Float[Tensor, "*#batch 3"], camera: Camera
    ) -> Float[Tensor, "*#batch"]:
        return _log_abs_det_projected(xyz, camera) - torch.log(self.depth.D * xyz[..., 2])


@dataclass(frozen=True)
class Cartesian(Chart):
    """The position itself, shifted and scaled: (x / xy_unit, y / xy_unit, z - z_centre); it ignores f.

    Args:
        depth: the data set's constants, of which z_centre is used.
        xy_unit: length of the unit of x and y, metres.

    Source: paper, baseline "MAE x, y, z".
    """

    has_projection: ClassVar[bool] = False
    depth: DepthScale
    xy_unit: float = 0.25

    def coordinates(self, xyz: Float[Tensor, "*#batch 3"], camera: Camera) -> Float[Tensor, "*#batch 3"]:
        return torch.cat([xyz[..., :2] / self.xy_unit, xyz[..., 2:] - self.depth.z_centre], dim=-1)

    def position(self, coordinates: Float[Tensor, "*#batch 3"], camera: Camera) -> Float[Tensor, "*#batch 3"]:
        return torch.cat(
            [coordinates[..., :2] * self.xy_unit, coordinates[..., 2:] + self.depth.z_centre], dim=-1
        )

    def log_abs_det_jacobian(
        self, xyz: Float[Tensor, "*#batch 3"], camera: Camera
    ) -> Float[Tensor, "*#batch"]:
        return torch.full_like(xyz[..., 2], -2 * math.log(self.xy_unit))

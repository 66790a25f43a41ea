"""What cameras measure of a position in the world: checked, and written as affine functions."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from phd_exp.fusion.pose import Pose, is_rotation


@runtime_checkable
class Affine(Protocol):
    """A density whose (q_x, q_y, t) are measure (v - apex) at a position v, such as `ProjectedHuber`."""

    @property
    def batch_shape(self) -> torch.Size:
        """Shape of the batch."""

    @property
    def measure(self) -> Float[Tensor, "*batch 3 3"]:
        """1/metres; NaN where the density is not valid."""

    @property
    def apex(self) -> Float[Tensor, "*batch 3"]:
        """Metres."""

    @property
    def mode(self) -> Float[Tensor, "*batch 3"]:
        """Metres."""

    @property
    def a(self) -> Float[Tensor, "*batch"]:
        """Precision of t; GAUSSIAN for a Gaussian density."""

    @property
    def rounding(self) -> float:
        """How far the mode of t is rounded, see `phd_exp.distributions.rounded`."""


GAUSSIAN = -1.0
"""In place of a: the density is Gaussian."""


class Status(IntEnum):
    """How a problem ended, with the `reason` in one line; all but FUSED are failures, with NaN instead of numbers."""

    reason: str

    FUSED = 0, "fused"
    NO_CAMERA = 1, "all cameras are masked out; expected at least one"
    NOT_FINITE = 2, "a prediction, pose or plane is not finite; mask out that camera or correct its numbers"
    NOT_A_ROTATION = 3, "the R of a pose is not a rotation to 1e-6; expected R R^T = I and |R| = 1"
    NOT_A_PLANE = 4, "the normal of the plane is zero; expected a direction"
    NO_COMMON_VIEW = (5, "no position is in front of every camera; check that poses map world to camera, R v + t")
    PLANE_BEHIND_CAMERA = 6, "no point of the plane is in front of every camera; check its normal and offset"
    CONTRADICTION = (
        7,
        "at least half of the views rule out every common position; check the poses, the plane, and that all "
        "cameras see the same object",
    )
    NOT_CONVERGED = 8, "the optimum was not found to machine precision; check whether the numbers are extreme"

    def __new__(cls, code: int, reason: str = "") -> "Status":
        status = int.__new__(cls, code)
        status._value_, status.reason = code, reason
        return status


@dataclass(frozen=True)
class Views:
    """(q_x, q_y, t) = slope (v - apex) of every camera, at positions v in the world; in float64, on the CPU.

    Args:
        predictions: as given.
        R: rotations from the world to the cameras.
        t: the world's origin in the camera frames, metres.
        slope: 1/metres; 0 where a camera is masked out.
        apex: world, metres; without a free axis the position of the camera.
        a: precision of the depth; 0 where a camera is masked out.
        mask: which cameras take part.
        status: FUSED where the input is valid.
    """

    predictions: Affine
    R: Float[np.ndarray, "problems cameras 3 3"]
    t: Float[np.ndarray, "problems cameras 3"]
    slope: Float[np.ndarray, "problems cameras 3 3"]
    apex: Float[np.ndarray, "problems cameras 3"]
    a: Float[np.ndarray, "problems cameras"]
    mask: Bool[np.ndarray, "problems cameras"]
    status: Int[np.ndarray, " problems"]

    @classmethod
    @np.errstate(invalid="ignore", over="ignore")  # numbers that are not finite are found below
    def of(cls, predictions: Affine, pose: Pose, mask: Bool[Tensor, "*problems cameras"] | None) -> "Views":
        """The views of the arguments of `fuse` or `track`. Raises ValueError where shapes do not broadcast."""
        shape = predictions.batch_shape
        if 0 in shape[-1:] or not shape:
            raise ValueError(f"predictions: got batch shape {tuple(shape)}; expected (*problems, cameras)")
        R, t = flat("pose.R", pose.R, shape, event=2), flat("pose.t", pose.t, shape, event=1)
        measure = flat("predictions", predictions.measure, shape, event=2)
        apex = flat("predictions", predictions.apex, shape, event=1)
        a = flat("predictions", predictions.a, shape)
        seen = np.full(a.shape, True) if mask is None else flat("mask", mask, shape) > 0
        slope, apex = measure @ R, _into_world(R, t, apex)
        finite = np.isfinite(slope.sum((-2, -1)) + apex.sum(-1) + a)
        valid = finite & ((a == GAUSSIAN) | (a > 0) & (measure[..., 2, 2] > 0))
        status = np.full(len(a), int(Status.FUSED))
        status[(~is_rotation(R) & seen).any(-1)] = Status.NOT_A_ROTATION
        status[(~valid & seen).any(-1)] = Status.NOT_FINITE
        status[~seen.any(-1)] = Status.NO_CAMERA
        slope, a = np.where(seen[..., None, None], slope, 0.0), np.where(seen, a, 0.0)
        return cls(predictions, R, t, slope, apex, a, seen, status)

    @property
    @np.errstate(invalid="ignore")
    def middle(self) -> Float[np.ndarray, "problems 3"]:
        """The average of the modes of the cameras that take part, world, metres; NaN without one."""
        shape = self.predictions.batch_shape
        modes = _into_world(self.R, self.t, flat("predictions", self.predictions.mode, shape, event=1))
        return np.where(self.mask[..., None], modes, 0.0).sum(1) / self.mask.sum(-1, keepdims=True)

    @property
    def cameras(self) -> Float[np.ndarray, "problems cameras 3"]:
        """The positions of the cameras, world, metres."""
        return _into_world(self.R, self.t, np.zeros(3))

    def at(self, v: Float[np.ndarray, "*#problems 3"]) -> Float[np.ndarray, "problems cameras 3"]:
        """(q_x, q_y, t) at positions in the world, metres; (0, 0, 1) where a camera is masked out."""
        values = (self.slope @ (v[..., None, :] - self.apex)[..., None])[..., 0]
        return np.where(self.mask[..., None], values, (0.0, 0.0, 1.0))


def own_width(a: Float[np.ndarray, "*views"], predictions: Affine) -> Float[np.ndarray, "*views"]:
    """The width of a rounded mode of t, see `phd_exp.fusion.arithmetic`; 0 for cameras that take no part."""
    found: np.ndarray = np.where(a > 0, predictions.rounding / np.where(a > 0, a, 1.0), 0.0)
    return found


def _into_world(R: np.ndarray, t: np.ndarray, v: np.ndarray) -> Float[np.ndarray, "*batch 3"]:
    """Camera frame to world, R^T (v - t)."""
    found: np.ndarray = (R.swapaxes(-1, -2) @ (v - t)[..., None])[..., 0]
    return found


def flat(name: str, value: Tensor, shape: torch.Size, event: int = 0, cameras: int = 1) -> Float[np.ndarray, "..."]:
    """The values in one dimension of problems, before those of cameras and event; in float64."""
    array = value.double().cpu().numpy()
    batch, own = array.shape[: array.ndim - event], array.shape[array.ndim - event :]
    try:
        expanded = np.broadcast_to(array, shape + own)
    except ValueError:
        raise ValueError(f"{name}: got batch shape {batch}; expected one that broadcasts to {tuple(shape)}") from None
    problems = shape[: len(shape) - cameras].numel()
    return np.array(expanded.reshape(problems, *shape[len(shape) - cameras :], *own))

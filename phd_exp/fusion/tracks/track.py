"""The most likely path of an object through the predictions of one or several cameras over time."""

import math
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import optimize
from torch import Tensor

from phd_exp.fusion.pose import Pose
from phd_exp.fusion.tracks.chain import VELOCITY, Array
from phd_exp.fusion.tracks.frames import Frames
from phd_exp.fusion.tracks.lost import USUAL, Lost
from phd_exp.fusion.tracks.motion import ConstantAcceleration, ConstantVelocity, Motion
from phd_exp.fusion.tracks.slow import NONE, Slow
from phd_exp.fusion.tracks.solved import Solved, smoothed
from phd_exp.fusion.views import GAUSSIAN, Affine, Views
from phd_exp.hardware import one_thread

M = TypeVar("M", ConstantVelocity, ConstantAcceleration)
WIDEST = math.log(1000)


@dataclass(frozen=True)
class Path:
    """A path in the world and its uncertainty; in float64, on the CPU.

    Numbers of frames before the first prediction and after the end of the track are NaN.

    Args:
        times: of all frames, seconds.
        first: the index of the first frame of the track.
        lost: why and when the track ended before the last frame; None if it did not.
        solved: the frames of the track; everything else is computed from it.
    """

    times: Float[Tensor, " frames"]
    first: int
    lost: str | None
    solved: Solved

    @property
    def point(self) -> Float[Tensor, "frames 3"]:
        """The most likely positions, metres."""
        return self._entered(self.solved.unknowns[:, :3] + self.solved.frames.origin)

    @property
    def velocity(self) -> Float[Tensor, "frames 3"]:
        """The velocities of the most likely path, metres per second."""
        return self._entered(self.solved.unknowns[:, VELOCITY])

    @property
    def surprise(self) -> Float[Tensor, "frames cameras"]:
        """Credible level of the path in each view, near 1 where they contradict; NaN where masked out."""
        return self._entered(self.solved.surprise)

    @property
    def mean(self) -> Float[Tensor, "frames 3"]:
        """The expected positions, metres."""
        return self._entered(self.solved.mean[:, :3] + self.solved.frames.origin)

    @property
    def covariance(self) -> Float[Tensor, "frames 3 3"]:
        """Covariance of each position about its mean, square metres; see `phd_exp.fusion.tracks.gaussian`."""
        return self._entered(self.solved.covariance[:, :3, :3])

    @property
    def velocity_covariance(self) -> Float[Tensor, "frames 3 3"]:
        """Covariance of each velocity, square metres per square second."""
        return self._entered(self.solved.covariance[:, VELOCITY, VELOCITY])

    @property
    def log_evidence(self) -> float:
        """Log density of the predictions given the motion, up to constants, nats."""
        return self.solved.moments.log_integral + float(np.linalg.slogdet(self.solved.chain.W)[1].sum()) / 2

    def _entered(self, values: Float[Array, "frames ..."]) -> Tensor:
        """With NaN for the frames outside the track."""
        whole = torch.full((len(self.times), *values.shape[1:]), torch.nan, dtype=torch.float64)
        whole[self.first : self.first + len(values)] = torch.from_numpy(values)
        return whole


@torch.no_grad()
def track(
    times: Float[Tensor, " frames"],
    predictions: Affine,
    pose: Pose,
    motion: Motion,
    mask: Bool[Tensor, "frames cameras"] | None = None,
    slow: Slow = NONE,
    lost: Lost = USUAL,
) -> Path:
    """The path of highest density: the product of the densities of all predictions and that of the motion.

    It minimises sum -log p_(k,i)(R v_k + t) plus half the squared noise of the motion over its variance. The problem
    is convex, and solved to rounding in O(frames). With slow errors, each frame has a weight for its depth and one
    for its projection, see `phd_exp.fusion.tracks.slow`, several cameras count as independent, and the problem is
    that about the path without slow errors, see `phd_exp.fusion.tracks.shear`.

    Args:
        times: of the frames, increasing, seconds.
        predictions: ProjectedHuber, or `Gaussian`, of batch shape (frames, cameras).
        pose: of each camera in each frame; its batch shape broadcasts to that.
        motion: `ConstantVelocity` or `ConstantAcceleration`; `estimated` finds its noise.
        mask: which cameras take part in each frame (default: all); the others' predictions and poses are ignored.
        slow: how long frames err alike (default: not at all); for ProjectedHuber only.
        lost: when the track ends.

    Raises:
        ValueError: an argument is not valid, or no path is in front of all cameras.

    Source: Aravkin, Burke and Pillonetto, "Optimization viewpoint on Kalman smoothing" (2013), for convex smoothing
    of paths; the densities are the paper's.
    """
    with one_thread():
        views = viewed(predictions, pose, mask, slow)
        shape = predictions.batch_shape
        if len(shape) != 2 or 0 in shape:
            raise ValueError(
                f"predictions: got batch shape {tuple(shape)}; expected (frames, cameras), none of them 0"
            )
        frames = Frames.checked(times.double().cpu().numpy(), views)
        seen = frames.mask.any(-1)
        first = int(np.argmax(seen))
        length, why = lost.gap(frames.times[first:], seen[first:])
        while True:
            solved = smoothed(frames[first : first + length], motion, slow)
            length, contradicted = lost.contradicted(solved)
            if contradicted is None:
                return Path(torch.from_numpy(frames.times), first, why, solved)
            why = contradicted


def viewed(predictions: Affine, pose: Pose, mask: Tensor | None, slow: Slow) -> Views:
    """The views of these arguments. Raises ValueError where one is not valid."""
    if not hasattr(type(predictions), "measure"):
        raise ValueError(
            f"predictions: got {type(predictions).__name__}; expected ProjectedHuber or Gaussian; use Gaussian.of "
            "for other densities; a point estimate has no uncertainty"
        )
    views = Views.of(predictions, pose, mask)
    if slow != NONE and (views.a == GAUSSIAN).any():
        raise ValueError("slow: got Gaussian predictions; expected ProjectedHuber")
    return views


def estimated(
    times: Float[Tensor, " frames"],
    predictions: Affine,
    pose: Pose,
    motion: M,
    mask: Bool[Tensor, "frames cameras"] | None = None,
    slow: Slow = NONE,
) -> M:
    """The motion with the noise of highest `log_evidence`, from 1/1000 to 1000 times the given one."""

    def loss(log_noise: float) -> float:
        moved = replace(motion, noise=math.exp(log_noise))
        return -track(times, predictions, pose, moved, mask, slow, Lost(math.inf, len(times) + 1)).log_evidence

    middle = math.log(motion.noise)
    found = optimize.minimize_scalar(loss, bounds=(middle - WIDEST, middle + WIDEST), method="bounded")
    return replace(motion, noise=math.exp(found.x))

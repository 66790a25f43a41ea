"""The most likely path of an object through the predictions of one or several cameras over time."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import optimize, special
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.level import credible_level
from phd_exp.fusion.pose import Pose
from phd_exp.fusion.problems import Status
from phd_exp.fusion.tracks.chain import Array, Model
from phd_exp.fusion.tracks.energy import GAUSSIAN, Chain
from phd_exp.fusion.tracks.frames import Frames, Gaussian
from phd_exp.fusion.tracks.lost import Lost
from phd_exp.fusion.tracks.motion import ConstantAcceleration, ConstantVelocity, Motion
from phd_exp.fusion.tracks.slow import Slow
from phd_exp.hardware import one_thread

# `kernels` is imported in the functions that use it: importing numba takes a second

M = TypeVar("M", ConstantVelocity, ConstantAcceleration)
NONE = Slow()
WIDEST = math.log(1000)
PASSES = 2  # about the path without slow errors, then about the path with them


class Moments(NamedTuple):
    """The Gaussian of a path: `mean` and `covariance` of each frame's unknowns.

    `factors` are the Gaussian ones in place of each camera's density, `freedom` is how many unknowns of a position
    each camera determines, and `log_integral` is that of the density over all paths, up to a constant; see
    `phd_exp.fusion.tracks.gaussian`.
    """

    mean: Float[Array, "frames d"]
    covariance: Float[Array, "frames d d"]
    factors: Float[Array, "frames cameras 7"]
    freedom: Float[Array, "frames cameras"]
    log_integral: float


@dataclass(frozen=True)
class Solved:
    """The frames of a track, and the optimum of their chain.

    Args:
        frames: of the track.
        model: the law of the unknowns.
        chain: the energy.
        x: the most likely unknowns, see `phd_exp.fusion.tracks.chain`.
        at: (q_x, q_y, t) there.
        energy: -log density up to constants, nats.
        gap: its bound.
        distance: bounds of each position, metres.
    """

    frames: Frames
    model: Model
    chain: Chain
    x: Float[Array, "frames d"]
    at: Float[Array, "frames cameras 3"]
    energy: float
    gap: float
    distance: Float[Array, " frames"]

    @cached_property
    def moments(self) -> "Moments":
        """Mean and covariance, on demand."""
        from phd_exp.fusion.tracks.kernels import moments

        mean, covariance = self.x.copy(), np.empty((*self.x.shape, self.x.shape[1]))
        freedom, factors = np.empty(self.chain.a.shape), np.empty((*self.chain.a.shape, 7))
        log_integral = moments(self.chain, mean, covariance, factors, freedom)
        return Moments(mean, covariance, factors, freedom, log_integral)

    @cached_property
    def excess(self) -> Float[Array, "frames cameras"]:
        """Energy of the path in each view above the view's lowest energy, nats."""
        q_x, q_y, t = np.moveaxis(self.at, -1, 0)
        inverse = 1 / np.where(t == 0, np.inf, t)  # t of a Gaussian prediction may be 0
        squared, a = q_x**2 + q_y**2, self.chain.a
        huber = np.where(squared > 1, np.sqrt(squared) - 0.5, squared / 2) + a * (np.maximum(t, inverse) - 1)
        return np.where(a == GAUSSIAN, (squared + t**2) / 2, huber)

    @property
    def surprise(self) -> Float[Array, "frames cameras"]:
        """Credible level of the path in each view; NaN where masked out."""
        return np.where(self.frames.mask, levels(self.excess, self.chain.a), np.nan)


def levels(excess: Float[Array, "*views"], a: Float[Array, "*views"]) -> Float[Array, "*views"]:
    """Credible levels of excess energies, under Gaussian predictions where a is GAUSSIAN."""
    if (a == GAUSSIAN).any():
        return special.gammainc(1.5, excess)
    return credible_level(torch.from_numpy(excess), torch.from_numpy(a)).numpy()


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
        return self._entered(self.solved.x[:, :3] + self.solved.frames.origin)

    @property
    def velocity(self) -> Float[Tensor, "frames 3"]:
        """The velocities of the most likely path, metres per second."""
        return self._entered(self.solved.x[:, self.solved.model.velocity])

    @property
    def slow(self) -> Float[Tensor, "frames slow"]:
        """The most likely slow errors in their standard deviations: of log depth, then of each camera's q."""
        return self._entered(self.solved.x[:, 3 : self.solved.model.measured_unknowns])

    @property
    def gap(self) -> float:
        """Upper bound on the energy of the path above the lowest energy, nats; inf where that is too flat."""
        return self.solved.gap

    @property
    def certificate(self) -> Float[Tensor, " frames"]:
        """Upper bound on the distance of each position from the true optimum, metres; inf as `gap`."""
        return self._entered(self.solved.distance)

    @property
    def surprise(self) -> Float[Tensor, "frames cameras"]:
        """Credible level of the path in each view, near 1 where they contradict; NaN where masked out."""
        return self._entered(self.solved.surprise)

    @property
    def mean(self) -> Float[Tensor, "frames 3"]:
        """The expected positions, metres."""
        return self._entered(self.solved.moments.mean[:, :3] + self.solved.frames.origin)

    @property
    def covariance(self) -> Float[Tensor, "frames 3 3"]:
        """Covariance of each position about its mean, square metres; see `phd_exp.fusion.tracks.gaussian`."""
        return self._entered(self.solved.moments.covariance[:, :3, :3])

    @property
    def velocity_covariance(self) -> Float[Tensor, "frames 3 3"]:
        """Covariance of each velocity, square metres per square second."""
        v = self.solved.model.velocity
        return self._entered(self.solved.moments.covariance[:, v, v])

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
    predictions: ProjectedHuber | Gaussian,
    pose: Pose,
    motion: Motion,
    mask: Bool[Tensor, "frames cameras"] | None = None,
    slow: Slow = NONE,
    lost: Lost = Lost(),
) -> Path:
    """The path of highest density: the product of the densities of all predictions and that of the motion.

    It minimises sum -log p_(k,i)(R v_k + t) plus half the squared noise of the motion over its variance. The problem
    is convex, and solved to rounding in O(frames). With slow errors it is convex about a given path, found first
    without them; then the factor of depth is linear, see `phd_exp.fusion.tracks.chain`, and errs by about s^2/2 for
    a factor e^s.

    Args:
        times: of the frames, increasing, seconds.
        predictions: of batch shape (frames, cameras).
        pose: of each camera in each frame; its batch shape broadcasts to that.
        motion: `ConstantVelocity` or `ConstantAcceleration`; `estimated` finds its noise.
        mask: which cameras take part in each frame (default: all); the others' predictions and poses are ignored.
        slow: the errors that consecutive frames share (default: none); for ProjectedHuber only.
        lost: when the track ends.

    Raises:
        ValueError: an argument is not valid, or no path is in front of all cameras.

    Source: Aravkin, Burke and Pillonetto, "Optimization viewpoint on Kalman smoothing" (2013), for convex smoothing
    of paths; the densities are the paper's.
    """
    with one_thread():
        frames = slow.frames(times, predictions, pose, mask)
        seen = frames.mask.any(-1)
        first = int(np.argmax(seen))
        length, why = lost.gap(frames.times[first:], seen[first:])
        while True:
            solved = _smoothed(frames[first : first + length], motion, slow)
            length, contradicted = lost.contradicted(solved.frames.times, solved.surprise)
            if contradicted is None:
                return Path(torch.from_numpy(frames.times), first, why, solved)
            why = contradicted


def _smoothed(frames: Frames, motion: Motion, slow: Slow) -> Solved:
    """The optimum; with a slow factor of depth, twice about the path given that factor, first 1."""
    cameras = frames.a.shape[1]
    model = Model(motion, replace(slow, depth_share=0.0), cameras)
    x = np.zeros((len(frames.times), len(model.start()[0])))
    x[:, :3] = frames.near
    solved = solve(model, frames, x, model.start(), None)
    if slow.depth_share:
        model = Model(motion, slow, cameras)
        x = np.insert(solved.x, 3, 0.0, axis=1)
        for _ in range(PASSES):
            solved = solve(model, frames, x, model.start(), solved.moments.freedom)
            x = solved.x
    return solved


def solve(
    model: Model,
    frames: Frames,
    about: Float[Array, "frames d"],
    start: tuple[Float[Array, " d"], Float[Array, "d d"]],
    freedom: Float[Array, "frames cameras"] | None,
) -> Solved:
    """The optimum of the frames, by a search from `about`, where the slow factor of depth is linear.

    A path of another size has another volume of paths around it: integrated over these, the density at a factor
    e^(d s) has a further factor e^(d s) for each unknown that a camera determines, their `freedom`. Without it, the
    factor would be too small.

    Raises:
        ValueError: there is none.
    """
    from phd_exp.fusion.tracks.kernels import most_likely

    slope, at_origin = model.measured(frames, about)
    linear = np.zeros_like(about)
    if freedom is not None:
        linear[:, 3] = -(frames.deviation * freedom).sum(-1)
    chain = Chain(slope, at_origin, frames.a, *start, *model.moving(np.diff(frames.times)), linear)
    x, at, distance = about.copy(), np.empty_like(at_origin), np.empty(len(about))
    in_front, energy, gap = most_likely(chain, x, at, distance)
    if not in_front:
        status = Status.NO_COMMON_VIEW if np.isfinite(x).all() else Status.NOT_CONVERGED
        raise ValueError(f"predictions: {status.reason}")
    return Solved(frames, model, chain, x, at, energy, gap, distance)


def estimated(
    times: Float[Tensor, " frames"],
    predictions: ProjectedHuber | Gaussian,
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

"""The optimum of the frames of a track, and its moments."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from scipy import special

from phd_exp.distributions.level import credible_level
from phd_exp.fusion.problems import Status
from phd_exp.fusion.tracks.chain import Array, Model
from phd_exp.fusion.tracks.energy import GAUSSIAN, Chain
from phd_exp.fusion.tracks.frames import Frames
from phd_exp.fusion.tracks.motion import Motion
from phd_exp.fusion.tracks.slow import Slow

# `kernels` is imported in the functions that use it: importing numba takes a second

PASSES = 2  # about the path without a slow factor, then about the path with it


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


def solve(
    model: Model,
    frames: Frames,
    about: Float[Array, "frames d"],
    motion: tuple[Array, Array, Array, Array],
    freedom: Float[Array, "frames cameras"] | None,
) -> Solved:
    """The optimum of the frames, by a search from `about`, where the slow factor of depth is linear.

    `motion` is what `Model.start` and `Model.moving` return, in a row.

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
    chain = Chain(slope, at_origin, frames.a, *motion, linear)
    x, at, distance = about.copy(), np.empty_like(at_origin), np.empty(len(about))
    in_front, energy, gap = most_likely(chain, x, at, distance)
    if not in_front:
        status = Status.NO_COMMON_VIEW if np.isfinite(x).all() else Status.NOT_CONVERGED
        raise ValueError(f"predictions: {status.reason}")
    return Solved(frames, model, chain, x, at, energy, gap, distance)


def smoothed(frames: Frames, motion: Motion, slow: Slow) -> Solved:
    """The optimum; with a slow factor of depth, twice about the path given that factor, first 1."""
    cameras = frames.a.shape[1]
    model = Model(motion, replace(slow, depth_share=0.0), cameras)
    x = np.zeros((len(frames.times), len(model.start()[0])))
    x[:, :3] = frames.near
    steps = np.diff(frames.times)
    solved = solve(model, frames, x, (*model.start(), *model.moving(steps)), None)
    if slow.depth_share:
        model = Model(motion, slow, cameras)
        x = np.insert(solved.x, 3, 0.0, axis=1)
        for _ in range(PASSES):
            moving = (*model.start(), *model.moving(steps))
            solved = solve(model, frames, x, moving, solved.moments.freedom)
            x = solved.x
    return solved

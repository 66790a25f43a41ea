"""The optimum of the frames of a track, and its moments."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from scipy import special

from phd_exp.distributions.rounded import depth_law
from phd_exp.fusion.tracks.chain import Array, moving, start
from phd_exp.fusion.tracks.energy import Chain
from phd_exp.fusion.tracks.frames import Frames
from phd_exp.fusion.tracks.motion import Motion
from phd_exp.fusion.tracks.shear import apart, sheared, unsheared, unsheared_covariance
from phd_exp.fusion.tracks.slow import NONE, Slow, weights
from phd_exp.fusion.views import GAUSSIAN, Status

# `kernels` is imported in the functions that use it: importing numba takes a second


class Moments(NamedTuple):
    """The Gaussian of a path: `mean` and `covariance` of each frame's sheared unknowns.

    `factors` are the Gaussian ones in place of each camera's density, and `log_integral` is that of the density over
    all paths, up to a constant; see `phd_exp.fusion.tracks.gaussian`.
    """

    mean: Float[Array, "frames d"]
    covariance: Float[Array, "frames d d"]
    factors: Float[Array, "frames cameras 7"]
    log_integral: float


@dataclass(frozen=True)
class Solved:
    """The frames of a track, and the optimum of their chain.

    Args:
        frames: of the track.
        chain: the energy.
        x: the most likely unknowns, see `phd_exp.fusion.tracks.chain`, sheared.
    """

    frames: Frames
    chain: Chain
    x: Float[Array, "frames d"]

    @cached_property
    def unknowns(self) -> Float[Array, "frames d"]:
        """The most likely unknowns."""
        return unsheared(self.frames.shear, self.x)

    @cached_property
    def mean(self) -> Float[Array, "frames d"]:
        """The expected unknowns."""
        return unsheared(self.frames.shear, self.moments.mean)

    @cached_property
    def covariance(self) -> Float[Array, "frames d d"]:
        """That of the unknowns of each frame."""
        return unsheared_covariance(self.frames.shear, self.moments.covariance)

    @cached_property
    def moments(self) -> "Moments":
        """Mean and covariance of the sheared unknowns, on demand."""
        from phd_exp.fusion.tracks.kernels import moments

        mean, covariance = self.x.copy(), np.empty((*self.x.shape, self.x.shape[1]))
        factors = np.empty((*self.chain.a.shape, 7))
        log_integral = moments(self.chain, mean, covariance, factors)
        return Moments(mean, covariance, factors, log_integral)

    @cached_property
    def excess(self) -> Float[Array, "frames cameras"]:
        """Energy of the path in each view above the view's lowest energy, nats."""
        from phd_exp.fusion.tracks.kernels import excesses

        frames, found = self.frames, np.empty(self.frames.a.shape)
        excesses(frames.slope, frames.at_origin, frames.a, frames.own, self.unknowns, found)
        return found

    @property
    def surprise(self) -> Float[Array, "frames cameras"]:
        """Credible level of the path in each view; NaN where masked out."""
        return np.where(self.frames.mask, levels(self.excess, self.frames.a, self.frames.own), np.nan)


def levels(
    excess: Float[Array, "*views"], a: Float[Array, "*views"], own: Float[Array, "*views"]
) -> Float[Array, "*views"]:
    """Credible levels of excess energies, under Gaussian predictions where a is GAUSSIAN."""
    if (a == GAUSSIAN).any():
        return special.gammainc(1.5, excess)
    log_a = torch.from_numpy(np.log(np.maximum(a, np.finfo(float).tiny)))
    found: Array = depth_law(log_a, float((own * a).max())).level(torch.from_numpy(excess)).numpy()
    return found


def solve(
    frames: Frames, x: Float[Array, "frames d"], motion: tuple[Array, Array, Array, Array], slow: Slow
) -> Solved:
    """The optimum of the frames, by a search from x.

    `motion` is what `start` and `moving` return, in a row.

    Raises:
        ValueError: there is none.
    """
    from phd_exp.fusion.tracks.kernels import most_likely

    a, p, views = frames.a, frames.mask.astype(float), (frames.slope, frames.at_origin)
    if slow != NONE:
        a, p = (weights(time, frames.since, frames.mask) for time in vars(slow).values())
        a, views = a * frames.a, apart(frames)
    chain = Chain(*views, a, p, frames.a, frames.own, *motion)
    x = x.copy()
    if not most_likely(chain, x, np.zeros(a.shape)):
        status = Status.NO_COMMON_VIEW if np.isfinite(x).all() else Status.NOT_CONVERGED
        raise ValueError(f"predictions: {status.reason}")
    return Solved(frames, chain, x)


def smoothed(frames: Frames, motion: Motion, slow: Slow) -> Solved:
    """The optimum of a whole track; with slow errors about that without them."""
    mean, precision = start(motion)
    x = np.zeros((len(frames.times), len(mean)))
    x[:, :3] = frames.about
    law = mean, precision, *moving(motion, np.diff(frames.times))
    solved = solve(frames, x, law, NONE)
    return solved if slow == NONE else solve(sheared(frames, solved.x[:, :3]), solved.x, law, slow)

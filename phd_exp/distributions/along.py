"""The law of the position's coordinate along any direction, such as the depth for another camera.

For a vector c, c . v = c . apex + (c . m) z + |g| q_1 in law, with m = (m_xy, 1) and g = A_xy^(-1) (c_x, c_y): the
depth z and q_1, any one coordinate of q, are independent.
"""

import math
from collections.abc import Callable
from functools import cache, cached_property, partial
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import special

from phd_exp.distributions.huber import RADIAL_NORMALISER, radial_icdf
from phd_exp.distributions.projected_huber import ProjectedHuber
from phd_exp.distributions.rounded import depth_law

if TYPE_CHECKING:
    from scipy.interpolate import CubicHermiteSpline

Values = Float[np.ndarray, " m"]

FURTHEST = 45.0  # the |q_1| beyond which no probability is left in float64
STEP = 0.005  # of the table of the law of q_1, which errs by less than 1e-9
_TAILS = (1e-14, 1e-9, 1e-5, 1e-3, 0.02, 0.1, 0.3)  # the law of depth is smooth between these quantiles
_BREAKS = np.array([-FURTHEST, -16.0, -8.0, -4.0, -2.0, -1.0, 0.0, 1.0, 2.0, 4.0, 8.0, 16.0, FURTHEST])
_LEAST_KAPPA = 1e-12  # moves a quantile by 1e-12 of the depth where the axis runs across the direction
_STEPS = 60  # of Newton's method at most, with bisection, and about four usually
_LAST_STEP = 1e-5  # of the width of the interval; the next one would be about its square
_LEAST = np.finfo(float).tiny
_COARSE, _FINE = 6, 16  # nodes of Gauss's rule between two breaks
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(_FINE)


def whitened_marginal(s: Float[np.ndarray, " values"]) -> Float[np.ndarray, " values"]:
    """The density of q_1 at s >= 0, m(s) = int exp(-h(sqrt(s^2 + w^2))) dw / (2 pi (1 + e^(-1/2))).

    Where s^2 + w^2 <= 1 it is an error function; the linear branch gives 2 e^(1/2) s K_1(s), less what lies inside
    the unit disc.

    Source: own derivation; checked against quadrature and samples.
    """
    positive = np.where(s > 0, s, 1)
    m = np.exp(0.5) * np.where(s > 0, positive * special.k1(positive), 1)
    inner = s < 1
    core = s[inner]
    half = np.sqrt(1 - core**2)
    quadratic = np.exp(-(core**2) / 2) * np.sqrt(np.pi / 2) * special.erf(half / np.sqrt(2))
    w = half[:, None] * (_NODES + 1) / 2
    m[inner] += quadratic - np.exp(0.5) * half / 2 * (np.exp(-np.hypot(core[:, None], w)) @ _WEIGHTS)
    return m / (math.pi * RADIAL_NORMALISER)


@cache
def _whitened_cdf() -> "CubicHermiteSpline":
    """P(q_1 <= s) for |s| <= `FURTHEST`: the integral of `whitened_marginal`, interpolated."""
    s = np.arange(round(FURTHEST / STEP) + 1) * STEP
    inside = s[:-1, None] + STEP * (_NODES + 1) / 2
    parts = whitened_marginal(inside.ravel()).reshape(inside.shape) @ _WEIGHTS * STEP / 2
    above, density = np.append(0, parts.cumsum()), whitened_marginal(s)
    cdf = 0.5 + np.concatenate([-above[:0:-1], above]) / (2 * above[-1])
    from scipy.interpolate import CubicHermiteSpline  # imported slowly, and a camera that is not turned needs none

    return CubicHermiteSpline(np.concatenate([-s[:0:-1], s]), cdf, np.concatenate([density[:0:-1], density]))


def _whitened_icdf(p: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    """The quantiles of q_1, interpolated linearly."""
    cdf = _whitened_cdf()
    return np.interp(p, cdf(cdf.x), cdf.x)


def quantiles_along(
    distribution: ProjectedHuber, direction: Float[np.ndarray, "n 3"], p: Float[np.ndarray, " quantiles"]
) -> Float[np.ndarray, "n quantiles"]:
    """The values s with P(direction . v <= s) = p, for p in (0, 1), of n distributions; metres for unit vectors.

    From the apex P = E[M((s - kappa z) / |g|)] with kappa = direction . m and the distribution function M of q_1, an
    integral over the law of depth, computed piecewise in float64 to about 1e-8, for a up to 1e10. Along (0, 0, 1) it
    is `depth_icdf`. A free axis may lead away from the direction (kappa < 0), which turns both round.

    Raises ValueError for a direction in which the mode does not lie.
    Source: own derivation (q and t are independent); checked against samples in tests/distributions/test_along.py.
    """
    parameters = (distribution.mode, distribution.m_xy, distribution.apex, distribution.mu_z, distribution.A)
    mode, m_xy, apex, mu_z, A = (tensor.detach().cpu().double().numpy() for tensor in parameters)
    if not ((direction * mode).sum(-1) > 0).all():
        raise ValueError("the mode lies 90 degrees or more from this direction")
    kappa = (direction[:, :2] * m_xy).sum(-1) + direction[:, 2]
    sign = np.where(kappa < 0, -1.0, 1.0)
    kappa = np.maximum(np.abs(kappa), _LEAST_KAPPA)
    p = np.where(sign[:, None] < 0, 1 - p, p)
    reach = np.linalg.norm(np.linalg.solve(A, direction[:, :2, None])[..., 0], axis=-1) * mu_z
    law = _DepthLaw(distribution)
    found = kappa[:, None] * law.icdf(p)
    turned = np.flatnonzero(reach > 0)
    if len(turned):
        # the quantiles of each part at half the probability enclose that of the sum
        far = np.stack([p / 2, 1 - (1 - p) / 2])
        radius = radial_icdf(torch.from_numpy(np.maximum(far, 1 - far))).numpy()
        low, high = (
            (kappa[:, None] * law.icdf(one) + side * reach[:, None] * q)[turned].ravel()
            for one, q, side in zip(far, radius, (-1, 1), strict=True)
        )
        rows = np.repeat(turned, p.shape[1])
        # for normal laws exact: the distances from the median are added as squares
        median = (kappa[:, None] * law.icdf(np.full((1, 1), 0.5)))[turned]
        apart = np.hypot(found[turned] - median, reach[turned, None] * _whitened_icdf(p[turned]))
        start = (median + np.where(p[turned] < 0.5, -apart, apart)).ravel()
        rows = np.repeat(turned, p.shape[1])
        root = start
        for nodes in (_COARSE, _FINE):  # the first leaves one step to the second
            of_sum = partial(law.of_sum, row=rows, kappa=kappa[rows], reach=reach[rows], nodes=nodes)
            root = _root(of_sum, p[turned].ravel(), low, root, high)
        found[turned] = root.reshape(-1, p.shape[1])
    return sign[:, None] * found + (direction * apex).sum(-1)[:, None]


def _root(
    law: Callable[[Values], tuple[Values, Values]], p: Values, low: Values, start: Values, high: Values
) -> Values:
    """The values between `low` and `high` with these probabilities, given a law: values -> cdf and density.

    By Newton's method; a step out of the interval, which shrinks, is replaced by its middle.
    """
    s, width = start.clip(low, high), high - low
    for _ in range(_STEPS):
        cdf, density = law(s)
        low, high = np.where(cdf < p, s, low), np.where(cdf < p, high, s)
        newton = s - (cdf - p) / np.maximum(density, _LEAST)
        is_last = (np.abs(newton - s) <= _LAST_STEP * width).all()
        s = np.where((low <= newton) & (newton <= high), newton, (low + high) / 2)
        if is_last:
            break
    return s


class _DepthLaw:
    """The laws of the depths of n distributions, as arrays."""

    def __init__(self, distribution: ProjectedHuber) -> None:
        mu_z, a = (one.detach().cpu().double() for one in (distribution.mu_z, distribution.a))
        self.distribution, self.mu_z, self.log_a = distribution, mu_z.numpy(), a.log()

    @cached_property
    def height(self) -> Float[np.ndarray, " n"]:
        """The density at the mode, 1/m."""
        law = depth_law(self.log_a, self.distribution.rounding)
        return np.asarray((-law.log_normaliser).exp().numpy() / self.mu_z)

    @cached_property
    def breaks(self) -> Float[np.ndarray, "n breaks"]:
        """The depths between which the law is smooth, m."""
        tails = np.array(_TAILS)[None]
        return np.concatenate([self.icdf(tails), self.mu_z[:, None], self.icdf(1 - tails[:, ::-1])], axis=1)

    def icdf(self, p: Float[np.ndarray, "#n quantiles"]) -> Float[np.ndarray, "n quantiles"]:
        """The depths with these probabilities below them, m."""
        return self.distribution.depth_icdf(torch.from_numpy(p.T)).detach().cpu().double().numpy().T

    def of_sum(
        self,
        s: Float[np.ndarray, " m"],
        row: Int[np.ndarray, " m"],
        kappa: Float[np.ndarray, " m"],
        reach: Float[np.ndarray, " m"],
        nodes: int,
    ) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
        """P(kappa z + reach q_1 <= s), of the depth z of each row, and its derivative by s."""
        breaks, mu_z = self.breaks[row], self.mu_z[row, None]
        of_q = (s[:, None] - reach[:, None] * _BREAKS) / kappa[:, None]
        edges = np.sort(np.concatenate([breaks, of_q.clip(breaks[:, :1], breaks[:, -1:])], axis=1), axis=1)
        (x, w), half = np.polynomial.legendre.leggauss(nodes), np.diff(edges)[..., None] / 2
        z = (edges[:, :-1, None] + half * (x + 1)).reshape(len(s), -1)
        law = depth_law(self.log_a[row, None], self.distribution.rounding)
        energy = law.energy(torch.from_numpy(np.log(z / mu_z))).numpy()
        weight = (half * w).reshape(len(s), -1) * self.height[row, None] * np.exp(-energy)
        at = ((s[:, None] - kappa[:, None] * z) / reach[:, None]).clip(-FURTHEST, FURTHEST)
        total, cdf = weight.sum(-1), _whitened_cdf()
        density = (weight * cdf(at, nu=1)).sum(-1) / (total * reach)
        return (weight * cdf(at)).sum(-1) / total, density

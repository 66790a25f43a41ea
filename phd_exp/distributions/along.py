"""The law of the position's coordinate along any direction, such as the depth for another camera.

For a vector c, c . v = c . apex + (c . m) z + |g| q_1 in law, with m = (m_xy, 1) and g = A_xy^(-1) (c_x, c_y): the
depth z and q_1, any one coordinate of q, are independent.
"""

from functools import cache

import numpy as np
import torch
from jaxtyping import Float

from phd_exp.distributions.projected_huber import ProjectedHuber
from phd_exp.distributions.rounded import depth_law

Values = Float[np.ndarray, " m"]

FURTHEST = 45.0  # the |q_1| beyond which no probability is left in float64
_POINTS = 600  # for an integral over w; eight times as many in the table, which errs by less than 1e-6
_TAILS = np.array([1e-14, 1e-9, 1e-5, 1e-3, 0.02, 0.1, 0.3])  # the law of depth is smooth between these quantiles
_BREAKS = np.array([1.0, 2.0, 4.0, 8.0, 16.0, FURTHEST])  # and that of q_1 between these values
_LEAST_KAPPA = 1e-12  # moves a quantile by 1e-12 of the depth where the axis runs across the direction
_STEPS = 60  # of Newton's method at most, with bisection, and about five usually
_LAST_STEP = 1e-5  # of the width of the interval; the next one would be about its square
_LEAST = np.finfo(float).tiny
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)  # between two breaks


@cache
def marginal() -> tuple[Values, Values, Values]:
    """Values s >= 0 of q_1, their density m(s) = int exp(-h(sqrt(s^2 + w^2))) dw / K, and P(q_1 <= s).

    By trapezoids in x with s = sinh x, which is even about 0; checked against quadrature and samples.
    """
    x, step = np.linspace(0, np.arcsinh(FURTHEST), 8 * _POINTS + 1, retstep=True)
    s, by_x = np.sinh(x), step * np.cosh(x)
    r = np.hypot(s[:, None], s[::8])
    m = np.exp(-np.where(r <= 1, r * r / 2, r - 0.5)) @ np.append(by_x[0] / 2, by_x[8::8])
    above = np.append(0, ((m * by_x)[1:] + (m * by_x)[:-1]).cumsum())  # twice the integrals
    return s, m / above[-1], 0.5 + above / (2 * above[-1])


def quantiles_along(
    distribution: ProjectedHuber, direction: Float[np.ndarray, "n 3"], p: Float[np.ndarray, " quantiles"]
) -> Float[np.ndarray, "n quantiles"]:
    """The values s with P(direction . v <= s) = p, for p in (0, 1), of n distributions; metres for unit vectors.

    From the apex P = E[M((s - kappa z) / |g|)] with kappa = direction . m and the distribution function M of q_1, an
    integral over the law of depth, computed piecewise in float64 to about 1e-6, for a up to 1e10. Along (0, 0, 1) it
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
    reach = np.linalg.norm(np.linalg.solve(A, direction[:, :2, None])[..., 0], axis=-1) * mu_z

    def of_depth(p: Float[np.ndarray, "#n quantiles"]) -> Float[np.ndarray, "n quantiles"]:
        return distribution.depth_icdf(torch.from_numpy(p.T)).detach().cpu().double().numpy().T

    p = np.where(sign[:, None] < 0, 1 - p, p)
    found = kappa[:, None] * of_depth(p)
    if turned := np.flatnonzero(reach > 0).tolist():
        breaks = np.concatenate([of_depth(_TAILS[None]), mu_z[:, None], of_depth(1 - _TAILS[None, ::-1])], axis=1)
        # the quantiles of each part at half the probability enclose that of the sum
        ends = [kappa[:, None] * of_depth(at) + reach[:, None] * _of_ray(at) for at in (p / 2, 1 - (1 - p) / 2)]
        rows = np.repeat(turned, p.shape[1])
        law = _Sum(distribution[torch.from_numpy(rows)], kappa[rows], reach[rows], breaks[rows])
        root = law.quantiles(p[turned].ravel(), *(end[turned].ravel() for end in ends))
        found[turned] = root.reshape(-1, p.shape[1])
    return sign[:, None] * found + (direction * apex).sum(-1)[:, None]


def _of_ray(p: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    """The quantiles of q_1."""
    s, _, cdf = marginal()
    return np.sign(p - 0.5) * np.interp(np.maximum(p, 1 - p), cdf, s)


class _Sum:
    """The laws of kappa z + reach q_1, of the depth z of each distribution, smooth between `breaks` of z."""

    def __init__(
        self, distribution: ProjectedHuber, kappa: Values, reach: Values, breaks: Float[np.ndarray, "m breaks"]
    ) -> None:
        mu_z, a = (one.detach().cpu().double() for one in (distribution.mu_z, distribution.a))
        self.mu_z, self.law = mu_z.numpy()[:, None], depth_law(a.log()[:, None], distribution.rounding)
        self.kappa, self.reach, self.breaks = kappa[:, None], reach[:, None], breaks

    def cdf(self, s: Values) -> tuple[Values, Values]:
        """The probability of values up to s, and the density."""
        of_ray = (s[:, None] - self.reach * np.concatenate([-_BREAKS, [0.0], _BREAKS])) / self.kappa
        edges = np.concatenate([self.breaks, of_ray.clip(self.breaks[:, :1], self.breaks[:, -1:])], axis=1)
        edges.sort(axis=1)
        half = np.diff(edges)[..., None] / 2
        z = (edges[:, :-1, None] + half * (_NODES + 1)).reshape(len(s), -1)
        energy = self.law.energy(torch.from_numpy(np.log(z / self.mu_z))).numpy()
        weight = (half * _WEIGHTS).reshape(len(s), -1) * np.exp(-energy)
        q = (s[:, None] - self.kappa * z) / self.reach
        at, density, above = marginal()
        cdf, total = np.interp(np.abs(q), at, above), weight.sum(-1)
        cdf = (weight * np.where(q < 0, 1 - cdf, cdf)).sum(-1)
        return cdf / total, (weight * np.interp(np.abs(q), at, density)).sum(-1) / (total * self.reach[:, 0])

    def quantiles(self, p: Values, low: Values, high: Values) -> Values:
        """The values between `low` and `high` with these probabilities, by Newton's method.

        A step out of the interval, which shrinks, is replaced by its middle.
        """
        s, width = (low + high) / 2, high - low
        for _ in range(_STEPS):
            cdf, density = self.cdf(s)
            low, high = np.where(cdf < p, s, low), np.where(cdf < p, high, s)
            newton = s - (cdf - p) / np.maximum(density, _LEAST)
            is_last = (np.abs(newton - s) <= _LAST_STEP * width).all()
            s = np.where((low <= newton) & (newton <= high), newton, (low + high) / 2)
            if is_last:
                break
        return s

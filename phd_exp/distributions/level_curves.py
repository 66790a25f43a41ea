"""Level curves of one predicted density: on the image, and from above (the paper's first figure).

A curve of level p bounds the smallest region that holds the probability p, of (x, y)/z on the image and of (x, z) in
the bird's-eye view. Both laws are marginals of the density of (x, y, z). Their curves are closed, and convex on the
image: p is log-concave, and then the integral of p(z u, z) z^2 over z, to the power -1/3, is convex in u.

Both are computed on a polar grid of half a plane, since both laws are symmetric about a line. The density of a curve
is a quantile of those of the grid's cells, and its points are interpolated along the rays.

Source: Ball, "Logarithmically concave functions and sections of convex sets in R^n" (1988); Hyndman, "Computing and
graphing highest density regions" (1996).
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from phd_exp.distributions.along import marginal
from phd_exp.distributions.projected_huber import ProjectedHuber
from phd_exp.distributions.rounded import depth_law

Points = Float[np.ndarray, "_ 2"]
Values = Float[np.ndarray, "radii rays"]

LEVELS = (0.5, 0.9, 0.99)
_RAYS = 37  # of half a plane
_REACH, _RADII, _CELLS = 10.0, 193, 1201  # of asinh(50 radius): radii up to 220 deviations, interpolated
_FURTHEST_ENERGY = 25.0  # of depth; beyond, no probability is left
_LEAST = -1e4  # log densities that are lower count as this


@dataclass(frozen=True)
class LevelCurves:
    """Closed curves of one distribution: (x, y)/z and (x, z) (metres) along each, for the probability inside it."""

    levels: tuple[float, ...]
    projected: tuple[Points, ...]
    birds_eye: tuple[Points, ...]
    mode: Float[np.ndarray, " 3"]
    """Position of highest density, metres."""


def level_curves(distribution: ProjectedHuber, levels: tuple[float, ...] = LEVELS) -> LevelCurves:
    """The curves of a distribution with an empty batch shape, computed in float64.

    Raises ValueError for a batch of distributions, or a level outside (0, 1).

    Examples:
        >>> p = ProjectedHuber(torch.zeros(2), torch.tensor(4.0), 100 * torch.eye(2), torch.tensor(20.0))
        >>> [curve.shape for curve in level_curves(p, (0.5, 0.9)).projected]
        [(73, 2), (73, 2)]
    """
    if distribution.batch_shape != torch.Size([]):
        raise ValueError(f"level curves are those of one distribution, not of {tuple(distribution.batch_shape)}")
    if not all(0 < level < 1 for level in levels):
        raise ValueError(f"levels lie between 0 and 1, exclusive; these are {levels}")
    curves = _on_image(distribution, levels), _from_above(distribution, levels)
    return LevelCurves(levels, *curves, mode=_float64(distribution.mode))


def on_image(projected: Float[np.ndarray, "*points 2"], f: float, S: float) -> Float[np.ndarray, "*points 2"]:
    """Pixels of (x, y)/z in an image of S pixels a side and focal length f (pixels): S/2 + f (x, y)/z."""
    return S / 2 + f * projected


def _on_image(distribution: ProjectedHuber, levels: tuple[float, ...]) -> tuple[Points, ...]:
    """Curves of w = A (u - mu_xy), which has the density E[t^2 exp(-h(|t w + k a (t - 1)|))] up to a constant.

    It is symmetric about the line of k. Source: own derivation; checked against samples and quadrature.
    """
    k = np.zeros(2) if distribution.k is None else _float64(distribution.k)
    size = float(np.linalg.norm(k))
    along = k / size if size else np.array([1.0, 0.0])
    frame = np.stack([along, [-along[1], along[0]]])
    s, t, weight = _depth_nodes(distribution, 64 + 40 * math.ceil(min(size, 20)))

    def log_density(w: Float[np.ndarray, "*points 2"]) -> Float[np.ndarray, "*points"]:
        r = np.hypot(t * w[..., :1] + size * s, t * w[..., 1:])
        return np.log(np.exp(-np.where(r <= 1, r * r / 2, r - 0.5)) @ weight + np.finfo(float).tiny)

    A = _float64(distribution.A)
    spread = frame @ A @ _float64(distribution.projected_covariance) @ A @ frame.T
    on_axis = -size * (s / t)[:, None] * [1, 0]
    grid = _Polar(on_axis[log_density(on_axis).argmax()], np.sqrt(spread.diagonal()), _RADII)
    value = log_density(grid.points)
    curves = grid.curves(value, np.zeros_like(value), levels)
    return tuple(_float64(distribution.mu_xy) + np.linalg.solve(A, (curve @ frame).T).T for curve in curves)


def _from_above(distribution: ProjectedHuber, levels: tuple[float, ...]) -> tuple[Points, ...]:
    """Curves of (log t, q_1): given z, x is on the axis plus |g| q_1 in law, with g the first row of mu_z A^(-1).

    So (x, z) has the density of t times that of q_1, both at their own scale.
    """
    law = depth_law(_log_a(distribution), distribution.rounding)
    grid = _Polar(np.zeros(2), np.array([float(law.farthest_log_t(torch.ones(()).double())), 1.0]), _CELLS)
    log_t, q = np.moveaxis(grid.points, -1, 0)
    s, density, _ = marginal()
    value = np.interp(np.abs(q), s, np.log(density)) - law.energy(torch.from_numpy(log_t)).numpy()
    mu_z, g = float(distribution.mu_z), np.linalg.norm(np.linalg.inv(_float64(distribution.A))[0])
    curves = []
    for curve in grid.curves(value, log_t, levels):
        z, q = mu_z * np.exp(curve[:, 0]), curve[:, 1]
        middle = float(distribution.apex[0]) + z * float(distribution.m_xy[0])
        curves.append(np.stack([middle + mu_z * g * q, z], axis=-1))
    return tuple(curves)


class _Polar:
    """A polar grid around a centre over the half plane above the first axis, in units of `scale`."""

    def __init__(self, centre: Float[np.ndarray, "2"], scale: Float[np.ndarray, "2"], radii: int) -> None:
        angle = np.linspace(0, np.pi, _RAYS)
        self.centre, self.rays = centre, np.stack([np.cos(angle), np.sin(angle)], -1) * scale / 50
        self.x = np.linspace(0, _REACH, radii)
        self.points = centre + np.sinh(self.x)[:, None, None] * self.rays

    def curves(self, log_density: Values, log_volume: Values, levels: tuple[float, ...]) -> list[Points]:
        """The closed curves of the levels of a density that falls along each ray, mirrored at the first axis.

        `log_volume` is that of a coordinate's unit in which the density is meant.
        """
        x = np.linspace(0, _REACH, _CELLS)
        falling = np.minimum.accumulate(np.maximum(log_density, _LEAST), axis=0).T
        value, volume = (np.stack([np.interp(x, self.x, ray) for ray in part]) for part in (falling, log_volume.T))
        mass = np.exp(value + volume - value.max()) * np.sinh(x) * np.cosh(x)
        mass[[0, -1]] /= 2  # each is the border of the other half too
        order = np.argsort(-value, axis=None)
        inside = mass.ravel()[order].cumsum()
        found = []
        for level in levels:
            threshold = np.interp(level * inside[-1], inside, value.ravel()[order])
            at = np.array([np.interp(-threshold, -ray, self.x) for ray in falling])
            half = np.sinh(at)[:, None] * self.rays
            found.append(self.centre + np.concatenate([half, half[-2::-1] * [1, -1]]))
        return found


def _depth_nodes(distribution: ProjectedHuber, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """a (t - 1), t and weights times t^2, each (2 n), of a Gauss rule on each side of the mode.

    The weights are known up to a factor. The nodes are denser near the mode, since log t is a multiple of y^2.
    """
    log_a = _log_a(distribution)
    law = depth_law(log_a, distribution.rounding)
    end = float(law.farthest_log_t(torch.tensor(_FURTHEST_ENERGY, dtype=torch.float64)))
    y, weight = np.polynomial.legendre.leggauss(n)
    y = (y + 1) / 2
    log_t = np.concatenate([end * y**2, -end * y**2])
    t = np.exp(log_t)
    weight = np.tile(weight * y, 2) * t * np.exp(-law.energy(torch.from_numpy(log_t)).numpy())
    return float(log_a.exp()) * np.expm1(log_t), t, weight * t**2


def _log_a(distribution: ProjectedHuber) -> torch.Tensor:
    return distribution.a.detach().cpu().double().log()


def _float64(values: torch.Tensor) -> np.ndarray:
    return values.detach().cpu().double().numpy()

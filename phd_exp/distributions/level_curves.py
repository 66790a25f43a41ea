"""Level curves of one predicted density: on the image, and from above (the paper's first figure).

A curve of level p bounds the smallest region that holds the probability p, of (x, y)/z on the image and of (x, z) in
the bird's-eye view. Both laws are marginals of the density of (x, y, z). Their curves are closed, and convex on the
image: p is log-concave, and then the integral of p(z u, z) z^2 over z, to the power -1/3, is convex in u.

Source: Ball, "Logarithmically concave functions and sections of convex sets in R^n" (1988).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from jaxtyping import Float
from scipy import integrate, optimize
from scipy.interpolate import CubicSpline
from scipy.optimize.elementwise import find_root

from phd_exp.distributions.along import FURTHEST, whitened_marginal
from phd_exp.distributions.depth_law import DepthLaw
from phd_exp.distributions.huber import radial_cdf
from phd_exp.distributions.projected_huber import ProjectedHuber
from phd_exp.distributions.rounded import depth_law

Points = Float[np.ndarray, "_ 2"]
_LogDensity = Callable[[np.ndarray], np.ndarray]

LEVELS = (0.5, 0.9, 0.99)
_POINTS = 73  # of a curve, and of half an outline
_STRATA = 500  # equally probable values of t that represent its law
_FURTHEST_ENERGY = 25.0  # of depth; beyond, no probability is left
_REACH, _RADII, _CELLS = 10.0, 97, 3000  # of asinh(50 radius): radii up to 220 deviations, interpolated


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
    middles = (torch.arange(_STRATA, dtype=torch.float64) + 0.5) / _STRATA  # of equally probable strata
    t = _float64(distribution.depth_icdf(middles) / distribution.mu_z)
    if distribution.k is None:
        projected = tuple(_ellipse(distribution, _radius(t, level)) for level in levels)
    else:
        projected = _free_curves(distribution, _float64(distribution.k), levels)
    return LevelCurves(
        levels=levels,
        projected=projected,
        birds_eye=tuple(_outline(distribution, _excess(distribution, t, level)) for level in levels),
        mode=_float64(distribution.mode),
    )


def on_image(projected: Float[np.ndarray, "*points 2"], f: float, S: float) -> Float[np.ndarray, "*points 2"]:
    """Pixels of (x, y)/z in an image of S pixels a side and focal length f (pixels): S/2 + f (x, y)/z."""
    return S / 2 + f * projected


def _float64(values: torch.Tensor) -> np.ndarray:
    return values.detach().cpu().double().numpy()


def _radius(t: Float[np.ndarray, " strata"], level: float) -> float:
    """The rho with P(|A (u - mu_xy)| <= rho) = level for u = (x, y)/z, where A (u - mu_xy) = q/t.

    Source: own derivation: the density of q/t falls with |q/t|, so its level sets are discs; checked against samples.
    """

    def excess(log_rho: float) -> float:
        return float(radial_cdf(torch.from_numpy(np.exp(log_rho) * t)).mean()) - level

    # |q| lies in [1e-6, 60] at any reasonable level
    return float(np.exp(optimize.brentq(excess, np.log(1e-6 / t.max()), np.log(60 / t.min()), xtol=1e-10)))


def _ellipse(distribution: ProjectedHuber, radius: float) -> Points:
    """u = mu_xy + A^(-1) rho (cos, sin), once around."""
    angle = np.linspace(0, 2 * np.pi, _POINTS)
    return _on_rays(distribution, radius * np.stack([np.cos(angle), np.sin(angle)], -1))


def _on_rays(distribution: ProjectedHuber, w: Points) -> Points:
    """The u = (x, y)/z with A (u - mu_xy) = w."""
    return _float64(distribution.mu_xy) + np.linalg.solve(_float64(distribution.A), w.T).T


def _free_curves(
    distribution: ProjectedHuber, k: Float[np.ndarray, " 2"], levels: tuple[float, ...]
) -> tuple[Points, ...]:
    """The curves on the image with a free axis.

    w = A (u - mu_xy) has the density E[t^2 exp(-h(|t w + k a (t - 1)|))] up to a constant, symmetric about the line
    of k. The density of a curve is a quantile of those on a polar grid around a point of that line; each point of the
    curve is then a root on its ray.
    """
    size = float(np.linalg.norm(k))
    along = k / size if size else np.array([1.0, 0.0])
    frame = np.stack([along, [-along[1], along[0]]])
    s, t, weight = _depth_nodes(distribution, 64 + 40 * math.ceil(min(size, 20)))

    def log_density(w: Float[np.ndarray, "*points 2"]) -> Float[np.ndarray, "*points"]:
        r = np.hypot(t * w[..., :1] + size * s, t * w[..., 1:])
        return np.log(np.exp(-np.where(r <= 1, r * r / 2, r - 0.5)) @ weight + np.finfo(float).tiny)

    A = _float64(distribution.A)
    spread = frame @ A @ _float64(distribution.projected_covariance) @ A @ frame.T
    angle = np.linspace(0, np.pi, _POINTS // 2 + 1)
    rays = np.stack([np.cos(angle), np.sin(angle)], -1) * np.sqrt(spread.diagonal()) / 50
    on_axis = -size * (s / t)[:, None] * [1, 0]
    centre = on_axis[log_density(on_axis).argmax()]
    halves = (_half(log_density, centre, rays, c) for c in _thresholds(log_density, centre, rays, levels))
    curves = (np.concatenate([half, half[-2::-1] * [1, -1]]) for half in halves)
    return tuple(_on_rays(distribution, curve @ frame) for curve in curves)


def _thresholds(log_density: _LogDensity, centre: np.ndarray, rays: Points, levels: tuple[float, ...]) -> np.ndarray:
    """The log densities of the curves with these probabilities inside, by a polar grid over half the plane."""
    x = np.linspace(0, _REACH, _RADII)
    coarse = CubicSpline(x, log_density(centre + np.sinh(x)[:, None, None] * rays))
    x = (np.arange(_CELLS) + 0.5) * (_REACH / _CELLS)
    height = coarse(x)
    mass = np.exp(height - height.max()) * (np.sinh(x) * np.cosh(x))[:, None]
    mass[:, [0, -1]] /= 2
    order = np.argsort(-height, axis=None)
    within = mass.ravel()[order].cumsum() - mass.ravel()[order] / 2
    return np.interp(levels, within / mass.sum(), height.ravel()[order])


def _half(log_density: _LogDensity, centre: np.ndarray, rays: Points, threshold: np.floating) -> Points:
    """The points with this log density on each ray from the centre."""

    def outside(x: np.ndarray, ray: np.ndarray) -> np.ndarray:
        return threshold - log_density(centre + np.sinh(x)[:, None] * rays[ray])

    ends = np.zeros(len(rays)), np.full(len(rays), _REACH)
    return centre + np.sinh(find_root(outside, ends, args=(np.arange(len(rays)),)).x)[:, None] * rays


def _depth_nodes(distribution: ProjectedHuber, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """a (t - 1), t and weights times t^2, each (2 n), of a Gauss rule on each side of the mode.

    The weights are known up to a factor. The nodes are denser near the mode, since log t is a multiple of y^2.
    """
    law = _depth_law(distribution)
    end = float(law.farthest_log_t(torch.tensor(_FURTHEST_ENERGY, dtype=torch.float64)))
    y, weight = np.polynomial.legendre.leggauss(n)
    y = (y + 1) / 2
    log_t = np.concatenate([end * y**2, -end * y**2])
    t = np.exp(log_t)
    weight = np.tile(weight * y, 2) * t * np.exp(-law.energy(torch.from_numpy(log_t)).numpy())
    return float(distribution.a) * np.expm1(log_t), t, weight * t**2


@cache
def _marginal() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of q_1, one coordinate of q: values s >= 0, its energy e(s) = log m(0)/m(s), and P(|q_1| <= s)."""
    s = np.concatenate([np.linspace(0, 2, 2001), np.linspace(2, FURTHEST, 4001)[1:]])
    m = whitened_marginal(s)
    cumulative = integrate.cumulative_simpson(m, x=s, initial=0)
    return s, -np.log(m / m[0]), cumulative / cumulative[-1]


def _depth_law(distribution: ProjectedHuber) -> DepthLaw:
    return depth_law(distribution.a.detach().cpu().double().log(), distribution.rounding)


def _depth_energy(distribution: ProjectedHuber, t: np.ndarray) -> np.ndarray:
    return np.asarray(_depth_law(distribution).energy(torch.from_numpy(np.log(t))).numpy())


def _excess(distribution: ProjectedHuber, t: np.ndarray, level: float) -> float:
    """The c with P(energy of t + e(q_1) <= c) = level."""
    _, energy, cumulative = _marginal()
    of_depth = _depth_energy(distribution, t)

    def surplus(c: float) -> float:
        return float(np.interp(c - of_depth, energy, cumulative, left=0).mean()) - level

    return float(optimize.brentq(surplus, 0, of_depth.max() + energy[-1], xtol=1e-10))


def _outline(distribution: ProjectedHuber, excess: float) -> Points:
    """The (x, z) with energy of t + e(q_1) = c, once around.

    Given z, x is on the axis plus |g| q_1 in law, where g is the first row of mu_z A^(-1); so (x, z) has the density
    of t times that of q_1, both at their own scale.

    Source: own derivation; the law of (x, z) is constant along the curve, checked by quadrature.
    """
    s, energy, _ = _marginal()
    mu_z = float(distribution.mu_z)
    furthest = float(_depth_law(distribution).farthest_log_t(torch.tensor(excess, dtype=torch.float64)).expm1())
    bend = np.linspace(0, np.pi / 2, (_POINTS + 1) // 2)
    above = 1 + furthest * np.sin(bend)  # dense where the curve closes
    t = np.concatenate([1 / above[:0:-1], above])
    of_depth = _depth_energy(distribution, t)
    half_width = mu_z * np.linalg.norm(np.linalg.inv(_float64(distribution.A))[0])
    half_width = half_width * np.interp(np.clip(excess - of_depth, 0, None), energy, s)
    z = mu_z * t
    middle = float(distribution.apex[0]) + z * float(distribution.m_xy[0])
    right, left = (np.stack([x, z], axis=-1) for x in (middle + half_width, middle - half_width))
    return np.concatenate([right, left[::-1], right[:1]])

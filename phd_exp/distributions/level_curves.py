"""Level curves of one predicted density: on the image, and from above (the paper's first figure).

A curve of level p bounds the smallest region that holds the probability p, of (x, y)/z on the image and of (x, z) in
the bird's-eye view. Both laws are marginals of the density of (x, y, z), and both have closed curves because q and t
are independent (see `ProjectedHuber`).
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from jaxtyping import Float
from scipy import integrate, optimize

from phd_exp.distributions.along import FURTHEST, whitened_marginal
from phd_exp.distributions.huber import radial_cdf
from phd_exp.distributions.projected_huber import ProjectedHuber

Points = Float[np.ndarray, "_ 2"]

LEVELS = (0.5, 0.9, 0.99)
_POINTS = 73  # of a curve, and of half an outline
_STRATA = 500  # equally probable values of t that represent its law


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
    return LevelCurves(
        levels=levels,
        projected=tuple(_ellipse(distribution, _radius(t, level)) for level in levels),
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
    circle = radius * np.stack([np.cos(angle), np.sin(angle)])
    return _float64(distribution.mu_xy) + np.linalg.solve(_float64(distribution.A), circle).T


@cache
def _marginal() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of q_1, one coordinate of q: values s >= 0, its energy e(s) = log m(0)/m(s), and P(|q_1| <= s)."""
    s = np.concatenate([np.linspace(0, 2, 2001), np.linspace(2, FURTHEST, 4001)[1:]])
    m = whitened_marginal(s)
    cumulative = integrate.cumulative_simpson(m, x=s, initial=0)
    return s, -np.log(m / m[0]), cumulative / cumulative[-1]


def _depth_energy(distribution: ProjectedHuber, t: np.ndarray) -> np.ndarray:
    return float(distribution.a) * (np.maximum(t, 1 / t) - 1)


def _excess(distribution: ProjectedHuber, t: np.ndarray, level: float) -> float:
    """The c with P(a (max(t, 1/t) - 1) + e(q_1) <= c) = level."""
    _, energy, cumulative = _marginal()
    of_depth = _depth_energy(distribution, t)

    def surplus(c: float) -> float:
        return float(np.interp(c - of_depth, energy, cumulative, left=0).mean()) - level

    return float(optimize.brentq(surplus, 0, of_depth.max() + energy[-1], xtol=1e-10))


def _outline(distribution: ProjectedHuber, excess: float) -> Points:
    """The (x, z) with a (max(t, 1/t) - 1) + e(q_1) = c, once around.

    Given z, x = z mu_x + |g| q_1 in law, where g is the first row of mu_z A^(-1); so (x, z) has the density of t
    times that of q_1, both at their own scale.

    Source: own derivation; the law of (x, z) is constant along the curve, checked by quadrature.
    """
    s, energy, _ = _marginal()
    mu_z = float(distribution.mu_z)
    furthest = 1 + excess / float(distribution.a)
    bend = np.linspace(0, np.pi / 2, (_POINTS + 1) // 2)
    above = 1 + (furthest - 1) * np.sin(bend)  # dense where the curve closes
    t = np.concatenate([1 / above[:0:-1], above])
    of_depth = _depth_energy(distribution, t)
    half_width = mu_z * np.linalg.norm(np.linalg.inv(_float64(distribution.A))[0])
    half_width = half_width * np.interp(np.clip(excess - of_depth, 0, None), energy, s)
    z = mu_z * t
    middle = z * float(distribution.mu_xy[0])
    right, left = (np.stack([x, z], axis=-1) for x in (middle + half_width, middle - half_width))
    return np.concatenate([right, left[::-1], right[:1]])

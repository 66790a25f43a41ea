"""The law of the position's coordinate along any direction, such as the depth for another camera.

For a vector c, c . v = (c . m) z + |g| q_1 in law, with m = (mu_x, mu_y, 1) and g = A_xy^(-1) (c_x, c_y): the depth z
and q_1, any one coordinate of q, are independent.
"""

import math

import numpy as np
import torch
from jaxtyping import Float
from scipy import optimize, special

from phd_exp.distributions.huber import RADIAL_NORMALISER, radial_icdf
from phd_exp.distributions.projected_huber import ProjectedHuber

FURTHEST = 45.0  # the |q_1| beyond which no probability is left in float64
_TAILS = (1e-14, 1e-9, 1e-5, 1e-3, 0.02, 0.1, 0.3)  # the law of depth is smooth between these quantiles
_BREAKS = np.array([-FURTHEST, -16.0, -8.0, -4.0, -2.0, -1.0, 0.0, 1.0, 2.0, 4.0, 8.0, 16.0, FURTHEST])
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)


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


def quantiles_along(
    distribution: ProjectedHuber, direction: Float[np.ndarray, "3"], p: Float[np.ndarray, " quantiles"]
) -> Float[np.ndarray, " quantiles"]:
    """The values s with P(direction . v <= s) = p, for p in (0, 1); metres for a unit vector.

    P = E[P(z <= (s - |g| q_1) / kappa)] with kappa = direction . m > 0, an integral over the law of q_1, computed
    piecewise in float64 to about 1e-8. Along (0, 0, 1) it is `depth_icdf`.

    Raises ValueError for a batch of distributions, or a direction in which the mode does not lie (kappa <= 0).
    Source: own derivation (q and t are independent); checked against samples in tests/distributions/test_along.py.
    """
    if distribution.batch_shape != torch.Size([]):
        raise ValueError(f"quantiles are those of one distribution, not of {tuple(distribution.batch_shape)}")
    parameters = (distribution.mu_xy, distribution.mu_z, distribution.A, distribution.a)
    mu_xy, mu_z, A, a = (tensor.detach().cpu().double() for tensor in parameters)
    depth = ProjectedHuber(mu_xy, mu_z, A, a)
    kappa = float(direction[:2] @ mu_xy.numpy() + direction[2])
    if not kappa > 0:
        raise ValueError("the mode lies 90 degrees or more from this direction")
    reach = float(np.linalg.norm(np.linalg.solve(A.numpy(), direction[:2]))) * float(mu_z)
    if reach == 0:
        return kappa * depth.depth_icdf(torch.as_tensor(p)).numpy()
    return np.array([_quantile(depth, kappa, reach, float(value)) for value in p])


def _quantile(depth: ProjectedHuber, kappa: float, reach: float, p: float) -> float:
    """The s with P(kappa z + reach q_1 <= s) = p."""
    quantiles = torch.tensor([*_TAILS, 0.5, *(1 - tail for tail in _TAILS)], dtype=torch.float64)
    z_breaks = np.append(depth.depth_icdf(quantiles).numpy(), float(depth.mu_z))

    def cdf(s: float) -> float:
        of_depth = np.clip((s - kappa * z_breaks) / reach, -FURTHEST, FURTHEST)
        edges = np.unique(np.concatenate([_BREAKS, of_depth]))
        half = np.diff(edges)[:, None] / 2
        q = (edges[:-1, None] + half * (_NODES + 1)).ravel()
        weight = (half * _WEIGHTS).ravel() * whitened_marginal(np.abs(q))
        return float(weight @ depth.depth_cdf(torch.from_numpy((s - reach * q) / kappa)).numpy())

    # the quantiles of each part at half the probability enclose that of the sum
    far = torch.tensor([p / 2, 1 - (1 - p) / 2], dtype=torch.float64)
    low, high = (kappa * depth.depth_icdf(far)).tolist()
    below, above = (reach * radial_icdf(torch.maximum(far, 1 - far))).tolist()
    root: float = optimize.brentq(lambda s: cdf(s) - p, low - below, high + above, rtol=1e-10)
    return root

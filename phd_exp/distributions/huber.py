"""Huber's function h and the radial law of q, the two-dimensional distribution with density exp(-h(|q|)) / K.

K = 2 pi Z with Z = 1 + e^(-1/2); in r = |q| the density is r exp(-h(r)) / Z.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

RADIAL_NORMALISER = 1 + math.exp(-0.5)
HUBER_COVARIANCE = (2 + 13 * math.exp(-0.5)) / (2 * RADIAL_NORMALISER)
"""c in Cov[q] = c I, 3.0765. Source: own derivation (int r^3 e^(-h) dr / 2Z); the paper's constant is a slip."""
HUBER_LOG_NORMALISER = math.log(2 * math.pi * RADIAL_NORMALISER)
"""log K. Source: paper, section "Norm factor of 2d Huber distribution"."""
HUBER_MEAN_ENERGY = (1 + 2.5 * math.exp(-0.5)) / RADIAL_NORMALISER
"""E[h(|q|)]. Source: own derivation (int h(r) r e^(-h) dr / Z), checked in tests/distributions/test_huber.py."""
_NEWTON_STEPS = 4  # from a relative error of 20 % at most to rounding


def huber_energy(q: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
    """The energy of a whitened projection, h(|q|) with h(r) = r^2/2 for r <= 1 and r - 1/2 beyond.

    Source: paper, section "Projected Huber distribution".
    """
    squared = q.square().sum(dim=-1)
    outer = squared > 1
    # the inner branch takes the root of 1, because its gradient at q = 0 is 0/0
    r = squared.masked_fill(~outer, 1).sqrt()
    return torch.where(outer, r - 0.5, squared / 2)


def energy_cdf(energy: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """P(h(|q|) <= energy) for energies >= 0.

    Source: own derivation; checked against quadrature in tests/distributions/test_huber.py.
    """
    inner = -torch.expm1(-energy)
    outer = RADIAL_NORMALISER - (energy + 1.5) * torch.exp(-energy)
    return torch.where(energy <= 0.5, inner, outer) / RADIAL_NORMALISER


def radial_icdf(p: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """The radius r with P(|q| <= r) = p, for p in [0, 1); it carries no gradient.

    Up to r = 1 it is sqrt(-2 log(1 - p Z)). Beyond, r - log(1 + r) = y with y = 1/2 - log((1 - p) Z) is solved by
    Newton's method from r = y + sqrt(2 y), an upper bound; the left side is convex, so the steps only go down.

    Source: own derivation; the bound is Chatzigeorgiou's on Lambert's W_(-1) (IEEE Communications Letters, 2013).
    """
    p = p.detach()
    inner_mass = -math.expm1(-0.5) / RADIAL_NORMALISER
    inner = torch.sqrt(-2 * torch.log1p(-p.clamp_max(inner_mass) * RADIAL_NORMALISER))
    y = 0.5 - torch.log((1 - p.clamp_min(inner_mass)) * RADIAL_NORMALISER)
    r = y + torch.sqrt(2 * y)
    for _ in range(_NEWTON_STEPS):
        r = r - (r - torch.log1p(r) - y) * (1 + r) / r
    return torch.where(p <= inner_mass, inner, r)


def sample_whitened(
    shape: torch.Size, *, dtype: torch.dtype, device: torch.device, generator: torch.Generator | None = None
) -> Float[Tensor, "*shape 2"]:
    """Samples of q: a radius by its inverse CDF, a direction at random."""
    p, turn = torch.rand((2, *shape), dtype=dtype, device=device, generator=generator)
    angle = 2 * math.pi * turn
    return radial_icdf(p)[..., None] * torch.stack([angle.cos(), angle.sin()], dim=-1)

"""Mean and covariance of a position whose density is the product of the cameras' densities.

A second derivative at the optimum misses the kinks of depth, which hold the optimum more often than not, and the
straight tails. So the Gaussian of second derivatives averaged over itself (`averaged_precision`) only places the
points at which the density is evaluated, and the moments follow from the values.
"""

import math
from functools import cache

import torch
from jaxtyping import Float
from scipy import stats
from torch import Tensor

from phd_exp.fusion.energy import energy
from phd_exp.fusion.linear import Triangle, backward, factor, forward, total
from phd_exp.fusion.views import Unknown, Views

_POINTS, PASSES = 256, 3
_FREEDOM = 5.0  # of Student's law, whose tails cover the exponential ones of the density
FIXED_POINT_STEPS = 6
_AT_ONCE = {"cpu": 1 << 17, "cuda": 1 << 24}
"""Cameras times points times problems: what stays in a processor's cache, and what keeps a GPU busy."""


def moments(views: Views, u: Unknown) -> tuple[Unknown, Float[Tensor, "k k problems"]]:
    """Mean (metres) and covariance (square metres) of u with density exp(-energy), of which u is the mode.

    Self-normalised importance sampling with a fixed set of 256 points of low discrepancy, which follow Student's law
    with 5 degrees of freedom: first about the mode, then twice more with the mean and covariance found so far. The
    same numbers every time. Of variances along axes 99 in 100 are within 15 %; 90 where one camera is alone, whose
    tails are the heaviest.

    Source: own derivation; checked against exact moments and Markov chains in tests/fusion/test_moments.py.
    """
    at_once = _AT_ONCE.get(u.device.type, _AT_ONCE["cuda"])
    size = max(1, at_once // (_POINTS * len(views.a)))
    parts = [_moments(*part) for part in zip(views.chunks(size), u.split(size, dim=-1), strict=True)]
    means, covariances = zip(*parts, strict=True)
    return torch.cat(means, dim=-1), torch.cat(covariances, dim=-1)


def _moments(views: Views, u: Unknown) -> tuple[Tensor, Tensor]:
    points, log_proposal = (part.to(u.device) for part in student_points(len(u)))
    precision = factor(averaged_precision(views, u))
    offset = backward([[entry[:, None] for entry in row] for row in precision], points[:, None])
    mean, covariance = _weighted(views, u, offset, log_proposal)
    for _ in range(PASSES - 1):
        root = factor([[covariance[i, j] for j in range(i + 1)] for i in range(len(u))])
        offset = _product(root, points)
        mean, covariance = _weighted(views, mean, offset, log_proposal)
    return mean, covariance


def _product(L: Triangle, points: Float[Tensor, "k points"]) -> Float[Tensor, "k problems points"]:
    """L times each point."""
    return torch.stack(
        [total(torch.stack([entry[:, None] * points[j] for j, entry in enumerate(row)]), 0) for row in L]
    )


def _weighted(
    views: Views,
    centre: Unknown,
    offset: Float[Tensor, "k problems points"],
    log_proposal: Float[Tensor, " points"],
) -> tuple[Unknown, Float[Tensor, "k k problems"]]:
    """Mean and covariance from the density at centre + offset, the points having been drawn from a proposal."""
    seen = views.seen(centre)[..., None]
    for j, component in enumerate(offset):
        seen = seen + views.slope[:, j, ..., None] * component
    value = total(energy(seen, views.a[..., None]), 0)
    weight = torch.softmax(-value - log_proposal, dim=-1)
    mean = (weight * offset).sum(-1)
    centred = offset - mean[..., None]
    return centre + mean, (weight * centred[:, None] * centred).sum(-1)


def averaged_precision(views: Views, u: Unknown) -> Triangle:
    """About the second derivative of the energy averaged over N(u, its inverse), a fixed point; 1/square metres.

    For h the weight 1/sqrt(1 + E|q|^2); for a max(t, 1/t), t Gaussian with deviation s, its jump of slope at the kink
    times the density there, and its curvature before: a (2 N(1; t, s^2) + 2 P(T < 1)/t^3).

    Source: own derivation.
    """
    seen = views.seen(u)
    squared, t = seen[0].square() + seen[1].square(), seen[2]
    zero = torch.zeros_like(t)
    weight, bend = (1 + squared).rsqrt(), views.a
    for _ in range(FIXED_POINT_STEPS):
        H = views.hessian(torch.stack([weight, zero, weight, bend]))
        variance = forward(factor(H), views.slope.transpose(0, 1)).square().sum(0)  # 3 cameras problems
        weight = (1 + squared + variance[0] + variance[1]).rsqrt()
        deviation = variance[2].sqrt().clamp_min(torch.finfo(t.dtype).tiny)
        standard = (1 - t) / deviation
        at_kink = torch.exp(-standard.square() / 2) / (deviation * math.sqrt(2 * math.pi))
        bend = views.a * (2 * at_kink + 2 * torch.special.ndtr(standard) / t**3)
    return views.hessian(torch.stack([weight, zero, weight, bend]))


@cache
def student_points(k: int) -> tuple[Float[Tensor, "k points"], Float[Tensor, " points"]]:
    """Points of Student's law in k = 2 or 3 dimensions, and the log of its density there up to a constant."""
    uniform = torch.from_numpy(stats.qmc.Sobol(k, scramble=True, seed=0).random(_POINTS))
    radius = torch.from_numpy(k * stats.f.ppf(uniform[:, 0].numpy(), k, _FREEDOM)).sqrt()
    turn = 2 * math.pi * uniform[:, 1]
    direction = torch.stack([turn.cos(), turn.sin()])
    if k == 3:
        height = 2 * uniform[:, 2:].T - 1
        direction = torch.cat([(1 - height.square()).sqrt() * direction, height])
    return radius * direction, -(_FREEDOM + k) / 2 * torch.log1p(radius.square() / _FREEDOM)

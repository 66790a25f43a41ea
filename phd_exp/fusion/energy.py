"""What is minimised, h(|q|) + a max(t, 1/t) summed over cameras, and a smooth stand-in for max(t, 1/t)."""

import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.distributions.level import credible_level
from phd_exp.fusion.views import Unknown, Views


def energy(seen: Float[Tensor, "3 *#batch"], a: Float[Tensor, "*#batch"]) -> Float[Tensor, "*#batch"]:
    """h(|q|) + a max(t, 1/t) of each camera; infinite for t <= 0.

    Source: paper, section "Projected Huber distribution".
    """
    t = seen[2]
    depth = torch.maximum(t, 1 / t).masked_fill(t <= 0, torch.inf)
    return huber(seen) + torch.where(a > 0, a * depth, 0)


def huber(seen: Float[Tensor, "3 *#batch"]) -> Float[Tensor, "*#batch"]:
    """h(|q|)."""
    squared = seen[0].square() + seen[1].square()
    return torch.where(squared > 1, squared.clamp_min(1).sqrt() - 0.5, squared / 2)


def extended_inverse(t: Tensor, least: float) -> tuple[Tensor, Tensor, Tensor]:
    """1/t with its first two derivatives, continued below t = least > 0 by its second-order Taylor polynomial.

    The continuation is convex and finite everywhere, so that a search may start behind a camera. A minimum of the
    continued problem that has t >= least in every camera is the minimum of the problem itself, by convexity.
    """
    inverse = 1 / t.clamp_min(least)
    short = (t - least).clamp_max(0) / least
    return inverse * (1 - short + short.square()), inverse.square() * (2 * short - 1), 2 * inverse**3


def smooth_energy(
    seen: Float[Tensor, "3 *#batch"], a: Float[Tensor, "*#batch"], width: float, least: float
) -> Float[Tensor, "*#batch"]:
    """The energy with max(t, 1/t) replaced by (t + 1/t)/2 + sqrt(g^2 + width^2), g = (t - 1/t)/2.

    This is the w of the epigraph's barrier, (w - t)(w - 1/t) = width^2. It is convex in t, because its second
    derivative is (1 - g/s)/t^3 + width^2 g'^2/s^3 with s = sqrt(g^2 + width^2), and at most `width` too large.

    Source: own derivation; convexity and distance checked in tests/fusion/test_energy.py.
    """
    t = seen[2]
    inverse = extended_inverse(t, least)[0]
    return huber(seen) + a * ((t + inverse) / 2 + (((t - inverse) / 2).square() + width**2).sqrt())


def surprise(views: Views, u: Unknown) -> Float[Tensor, "cameras problems"]:
    """Credible level of u in each view: how much probability lies closer to what the view says."""
    return credible_level(energy(views.seen(u), views.a) - views.a, views.a)

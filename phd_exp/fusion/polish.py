"""The exact problem from the smoothed one: kinks at which the optimum lies become equalities t = 1."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from phd_exp.fusion.linear import solve
from phd_exp.fusion.views import Seen, Unknown, Views

KINK = 1e-6
"""|t - 1| within which a kink may be what holds the optimum; the smoothed optimum is about 1e-9 from one that is."""
ROUNDS = 4
PENALTY = 1e7
RIDGE = 1e-12
FARTHEST = 1e-4  # metres; a correction beyond is no polish


def polish(
    views: Views, u: Unknown, lam: Float[Tensor, "cameras problems"]
) -> tuple[Unknown, Float[Tensor, "cameras problems"]]:
    """The optimum to rounding, and the subgradients lam of max(t, 1/t) at kinks.

    The method of multipliers: at a kink the energy is a (lam (t - 1) + penalty (t - 1)^2 / 2), and lam moves by the
    penalty times what is left of t - 1. A lam that leaves [-1, 1] was none: its camera goes to that side.
    Where a problem was farther from its optimum than that, it is returned as it came.

    Source: own derivation; checked against a conic solver in tests/fusion/test_conic.py.
    """
    start, first = u, lam
    for _ in range(ROUNDS):
        seen = views.seen(u)
        near = (seen[2] - 1).abs() <= KINK
        side = torch.where(near, lam, seen[2] - 1).sign()
        kink = near & (lam.abs() < 1)
        du = -_newton_step(views, seen, lam, side, kink)
        u = u + du
        lam = torch.where(kink, lam + PENALTY * (views.seen(u)[2] - 1), side)
    moved = (u - start).abs().amax(0)
    good = moved <= FARTHEST  # false for NaN
    return torch.where(good, u, start), torch.where(good, lam, first).clamp(-1, 1)


def _newton_step(
    views: Views,
    seen: Seen,
    lam: Float[Tensor, "cameras problems"],
    side: Float[Tensor, "cameras problems"],
    kink: Bool[Tensor, "cameras problems"],
) -> Unknown:
    """H^(-1) times the gradient of what `polish` describes, h by its second derivative."""
    q, t = seen[:2], seen[2]
    weight = (q[0].square() + q[1].square()).clamp_min(1).rsqrt()
    unit = torch.where(weight < 1, q * weight, 0)
    slope = torch.where(side > 0, 1, -t.square().reciprocal())
    slope = torch.where(kink, lam + PENALTY * (t - 1), slope)
    bend = torch.where(kink, PENALTY, torch.where(side > 0, 0, 2 / t**3))
    curvature = (
        weight * (1 + RIDGE - unit[0].square()),
        -weight * unit[0] * unit[1],
        weight * (1 + RIDGE - unit[1].square()),
        views.a * (bend + RIDGE),
    )
    gradient = views.gradient(torch.stack([*(weight * q), views.a * slope]))
    return solve(views.hessian(torch.stack(curvature)), gradient)

"""How good an optimum is, from the subgradients alone: whoever found it, and however."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from phd_exp.fusion.linear import factor, forward, total
from phd_exp.fusion.polish import KINK
from phd_exp.fusion.views import Seen, Unknown, Views

RADII = (1e-8, 1e-6, 1e-4, 1e-2)  # metres; balls in which the curvature is bounded from below


@dataclass(frozen=True)
class Certificate:
    """What is known of a point without knowing the optimum.

    Args:
        subgradient: norm of a subgradient of the summed energy, nats per metre; 0 proves the optimum.
        relative: the same over sum a |dt/du|, the pull of depth alone; without unit.
        distance: the optimum is no farther than this, metres; inf where the energy is too flat to tell.
    """

    subgradient: Float[Tensor, " problems"]
    relative: Float[Tensor, " problems"]
    distance: Float[Tensor, " problems"]


def certify(views: Views, u: Unknown, lam: Float[Tensor, "cameras problems"]) -> Certificate:
    """The certificate of a point, for subgradients lam in [-1, 1] at kinks.

    Let G be the subgradient. At any other point u + d the energy is larger by at least

        G.d + d.H d/2 - e    while |d| <= rho,

    where H bounds the curvature from below within that radius. To it a kink adds 2 a (1 - |lam|)/(|r| rho) r r^T with
    r = dt/du, because its energy grows by a (1 - |lam|) |r.d|; and e = sum 3 a |t - 1| covers what kinks are off.
    An optimum is no higher, so its d has |d| <= sqrt(tr H^(-1)) (|G| + sqrt(|G|^2 + 2 e)) with |G|^2 = G.H^(-1) G.
    If that is at most rho, it bounds the distance; by convexity no optimum lies outside the ball either.

    Source: own derivation; checked against a conic solver in tests/fusion/test_conic.py.
    """
    seen = views.seen(u)
    kink = ((seen[2] - 1).abs() <= KINK) & (lam.abs() < 1)
    by_seen = _subgradient(seen, views.a, lam, kink)
    G = views.gradient(by_seen)
    pull = total(views.a * views.slope[2].square().sum(0).sqrt(), 0)
    error = total(torch.where(kink, 3 * views.a * (seen[2] - 1).abs(), 0), 0)
    distance = torch.full_like(pull, torch.inf)
    left = torch.arange(len(pull), device=pull.device)
    # a larger ball has less curvature, and so a larger bound: the first to hold is the best
    for radius in RADII:
        part = (views.subset(left), seen[..., left], lam[:, left], kink[:, left])
        bound = _distance(*part, radius, G[:, left], error[left])
        holds = bound <= radius
        distance[left[holds]] = bound[holds]
        left = left[~holds]
        if len(left) == 0:
            break
    norm = G.square().sum(0).sqrt()
    return Certificate(norm, norm / pull, distance)


def _subgradient(
    seen: Seen, a: Tensor, lam: Tensor, kink: Bool[Tensor, "cameras problems"]
) -> Float[Tensor, "3 cameras problems"]:
    """With respect to what is seen."""
    weight = (seen[0].square() + seen[1].square()).clamp_min(1).rsqrt()
    depth = torch.where(seen[2] >= 1, 1, -seen[2].square().reciprocal())
    return torch.stack([seen[0] * weight, seen[1] * weight, a * torch.where(kink, lam, depth)])


def _distance(
    views: Views, seen: Seen, lam: Tensor, kink: Tensor, radius: float, G: Unknown, error: Tensor
) -> Float[Tensor, " problems"]:
    """The bound for one radius; NaN or inf where H is not positive definite."""
    L = factor(views.hessian(_least_curvature(views, seen, lam, kink, radius)))
    axes = torch.eye(len(G), dtype=G.dtype, device=G.device)[..., None].expand(-1, *G.shape)
    trace = total(total(torch.stack([forward(L, axis).square() for axis in axes]), 0), 0)
    squared = total(forward(L, G).square(), 0)
    return (trace.sqrt() * (squared.sqrt() + (squared + 2 * error).sqrt())).nan_to_num(nan=torch.inf)


def _least_curvature(
    views: Views, seen: Seen, lam: Tensor, kink: Tensor, radius: float
) -> Float[Tensor, "4 cameras problems"]:
    """A lower bound of the curvature within a radius of u, with respect to what is seen.

    |q| changes by at most delta. Below 1 - delta, h has curvature 1; else at least (P - delta/|q|)/(|q| + delta).
    P projects across q, whose direction turns by at most asin(delta/|q|), and projectors differ in norm by the sine.
    """
    squares = views.slope.square().sum(1)
    delta = (squares[0] + squares[1]).sqrt() * radius
    length = (seen[0].square() + seen[1].square()).sqrt()
    inside = length + delta < 1
    unit = seen[:2] / length.clamp_min(0.5)
    turn = delta / length.clamp_min(0.5)
    scale = torch.where(turn < 1, 1 / (length + delta), 0)
    xx, xy, yy = (
        scale * (1 - turn - unit[0].square()), -scale * unit[0] * unit[1], scale * (1 - turn - unit[1].square())
    )  # fmt: skip
    reach = squares[2].sqrt() * radius
    far = seen[2] + reach
    depth = torch.where(far < 1, 2 / far**3, 0)
    depth = torch.where(kink, 2 * (1 - lam.abs()) / reach.clamp_min(torch.finfo(far.dtype).tiny), depth)
    ones = torch.ones_like(length)
    return torch.stack(
        [
            torch.where(inside, ones, xx),
            torch.where(inside, 0, xy),
            torch.where(inside, ones, yy),
            views.a * depth,
        ]
    )

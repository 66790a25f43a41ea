"""The smoothed problem by a primal-dual Newton method, the whole batch at once.

Plain Newton steps see no curvature where h or max(t, 1/t) is straight and overshoot. So, as in total-variation
denoising (Chan, Golub and Mulet, 1999), the directions of both are unknowns of their own:

    y max(1, |q|) = q,    lam sqrt(g^2 + width^2) = g    with |y| <= 1, |lam| <= 1,

each linearised with the stationarity in u. From y = 0, lam = 0 the first steps are those of reweighted least squares,
the last ones quadratic. The width falls to its floor meanwhile; a line search keeps every step a descent.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from phd_exp.fusion.energy import extended_inverse, huber, smooth_energy
from phd_exp.fusion.linear import solve, total
from phd_exp.fusion.views import Seen, Unknown, Views

WIDTH_FLOOR = 1e-9
FIRST_WIDTH, SHRINK = 1.0, 0.01
MOST_STEPS, MOST_HALVINGS = 80, 40
SETTLED = 1e-9  # relative change of what is seen
RIDGE = 1e-9  # share of the curvature of least squares: a flat direction must not stop the rest
ARMIJO = 1e-4


@dataclass(frozen=True)
class Iterate:
    """The unknowns and the two duals."""

    u: Unknown
    y: Float[Tensor, "2 cameras problems"]
    lam: Float[Tensor, "cameras problems"]

    @classmethod
    def start(cls, views: Views, u: Unknown) -> "Iterate":
        """No curvature is known yet."""
        return cls(u, torch.zeros_like(views.at_origin[:2]), torch.zeros_like(views.a))

    def subset(self, problems: Int[Tensor, " some"]) -> "Iterate":
        """Some of the problems."""
        return Iterate(self.u[:, problems], self.y[..., problems], self.lam[:, problems])


def minimise(views: Views, u: Unknown, least: float) -> tuple[Unknown, Float[Tensor, "cameras problems"]]:
    """The minimum over u and the multipliers lam of the kinks; 1/t is continued below t = least.

    A problem that has settled leaves the batch. What has not settled after 80 steps is returned as it is: the
    certificate judges it.
    """
    at, width = Iterate.start(views, u), FIRST_WIDTH
    result, working = Iterate(u.clone(), at.y, at.lam.clone()), torch.arange(u.shape[1], device=u.device)
    for _ in range(MOST_STEPS):
        at, settled = step(views, at, width, least)
        result.u[:, working], result.lam[:, working] = at.u, at.lam
        if width == WIDTH_FLOOR and bool(settled.any()):
            left = (~settled).nonzero().squeeze(-1)
            if len(left) == 0:
                break
            views, at, working = views.subset(left), at.subset(left), working[left]
        width = max(width * SHRINK, WIDTH_FLOOR)
    return result.u, result.lam


def step(views: Views, at: Iterate, width: float, least: float) -> tuple[Iterate, Bool[Tensor, " problems"]]:
    """One Newton step with its line search, and which problems it hardly moved."""
    seen, a = views.seen(at.u), views.a
    q, t = seen[:2], seen[2]
    weight = (q[0].square() + q[1].square()).clamp_min(1).rsqrt()
    unit = torch.where(weight < 1, q * weight, 0)  # q/|q| where h is straight
    inverse, first, second = extended_inverse(t, least)
    g, g_slope = (t - inverse) / 2, (1 - first) / 2
    s = (g.square() + width**2).sqrt()
    side = g / s
    gradient = views.gradient(torch.stack([*(weight * q), a * ((1 + first) / 2 + side * g_slope)]))
    y_x, y_y = at.y
    curvature = (
        weight * (1 - y_x * unit[0]),
        -weight * (y_x * unit[1] + y_y * unit[0]) / 2,
        weight * (1 - y_y * unit[1]),
        a * ((1 - side) * second / 2 + g_slope.square() * (1 - at.lam * side) / s),
    )
    least_squares = torch.stack([weight, torch.zeros_like(a), weight, a])
    du = -solve(views.hessian(torch.stack(curvature) + RIDGE * least_squares), gradient)
    moved = views.moved(du)
    before = total(huber(seen) + a * ((t + inverse) / 2 + s), 0)
    share = _line_search(before, seen, moved, a, (gradient * du).sum(0), width, least)
    lam = at.lam + (g - at.lam * s + (1 - at.lam * side) * g_slope * moved[2]) / s
    y = weight * (q + moved[:2] - at.y * (unit * moved[:2]).sum(0))
    y = y * (y[0].square() + y[1].square()).clamp_min(1).rsqrt()
    still = (share * moved).abs() <= SETTLED * (1 + seen.abs())
    return Iterate(at.u + share * du, y, lam.clamp(-1, 1)), still.all(0).all(0)


def _line_search(
    before: Float[Tensor, " problems"],
    seen: Seen,
    moved: Seen,
    a: Float[Tensor, "cameras problems"],
    descent: Float[Tensor, " problems"],
    width: float,
    least: float,
) -> Float[Tensor, " problems"]:
    """The share of each step to take: halved until the energy falls from what it was before by Armijo's rule."""

    def value(seen: Seen, a: Tensor) -> Tensor:
        return total(smooth_energy(seen, a, width, least), 0)

    enough = before + 1e-12 * before.abs()  # what rounding may add where nothing is left to gain
    share = torch.ones_like(before)
    tried = (value(seen + moved, a) > enough + ARMIJO * descent).nonzero().squeeze(-1)
    for _ in range(MOST_HALVINGS):
        if len(tried) == 0:
            break
        share[tried] /= 2
        after = value(seen[..., tried] + share[tried] * moved[..., tried], a[:, tried])
        tried = tried[after > enough[tried] + ARMIJO * share[tried] * descent[tried]]
    return share

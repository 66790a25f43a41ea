"""One position from the predictions of several cameras that saw the same object, and perhaps from a plane."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.fusion import solver
from phd_exp.fusion.fused import Fused
from phd_exp.fusion.pose import Plane, Pose
from phd_exp.fusion.problems import Problems
from phd_exp.fusion.status import Status
from phd_exp.fusion.views import Unknown, Views
from phd_exp.threads import one_thread

LEAST_DEPTHS = (1e-2, 1e-4, 1e-6)
"""Shares of the predicted depth below which 1/t is continued, one after the other till the optimum lies beyond."""
CONVERGED = 1e-6
"""The largest relative subgradient at which a problem counts as solved."""


@torch.no_grad()
def fuse(
    predictions: ProjectedHuber,
    pose: Pose,
    plane: Plane | None = None,
    mask: Bool[Tensor, "*problems cameras"] | None = None,
    contradiction: float = 1e-9,
) -> Fused:
    """The position v of highest sum_i log p_i(R_i v + t_i), optionally among the points of a plane.

    A convex problem, non-smooth where z = mu_z; all problems are solved at once, in float64, on the predictions'
    device. A problem that fails says why in `status` and leaves the others alone.

    Args:
        predictions: of batch shape (*problems, cameras).
        pose: of each camera; its batch shape broadcasts to that.
        plane: one for each problem, or one for all.
        mask: which cameras take part (all, if left out); what the others hold is never looked at.
        contradiction: a view rules a position out if it gives less than this probability to all positions that are
            no more likely. A problem fails if at least half of its views rule out its optimum; with 0, none does.

    Raises:
        ValueError: shapes do not fit one another.

    Source: paper, section "Multi-view fusion and ground plane constraints".
    """
    with one_thread():
        return _fuse(
            Problems.posed(predictions, pose, plane, mask), predictions.batch_shape[:-1], contradiction
        )


def _fuse(problems: Problems, shape: torch.Size, contradiction: float) -> Fused:
    """The problems, which were posed in this shape, solved and judged."""
    status = problems.status(*solver.soundness(problems))
    sound = (status == Status.FUSED).nonzero().squeeze(-1)
    part = problems.subset(sound)
    views = solver.views(part)
    u, lam, seen = find_optimum(views)
    unseen, seen = (~seen).nonzero().squeeze(-1), seen.nonzero().squeeze(-1)
    status[sound[unseen]] = _why_unseen(part.subset(unseen))
    part, views = part.subset(seen), views.subset(seen)
    optima = Optima(part, views, *solver.polish(views, u[:, seen], lam[:, seen]))
    return _judged(optima, sound[seen], status, shape, contradiction)


def find_optimum(
    views: Views,
) -> tuple[Unknown, Float[Tensor, "cameras problems"], Bool[Tensor, " problems"]]:
    """The optimum and its multipliers, and whether every camera has it at more than 1e-6 of its predicted depth.

    Where it has not, every position in front of all cameras is worse than what 1/t = 1e6 in one camera costs.
    """
    u = torch.zeros_like(views.slope[0, :, 0])
    lam, seen = torch.zeros_like(views.a), torch.zeros_like(views.a[0], dtype=torch.bool)
    for least in LEAST_DEPTHS:
        rest = (~seen).nonzero().squeeze(-1)
        if len(rest) == 0:
            break
        part = views.subset(rest)
        u[:, rest], lam[:, rest] = solver.minimise(part, u[:, rest], least)
        seen[rest] = (part.seen(u[:, rest])[2] >= least).all(0)
    return u, lam, seen


def _why_unseen(problems: Problems) -> Int[Tensor, " problems"]:
    """Is it the plane, or have the cameras nothing in common anyway?"""
    status = torch.full_like(problems.mask[:, 0], int(Status.NO_COMMON_VIEW), dtype=torch.long)
    if problems.plane is not None and len(status) > 0:
        seen = find_optimum(solver.views(problems.without_plane()))[2]
        status[seen] = Status.PLANE_BEHIND_CAMERA
    return status


@dataclass(frozen=True)
class Optima:
    """Problems, what their cameras see, and their polished optima with multipliers."""

    problems: Problems
    views: Views
    u: Float[Tensor, "k problems"]
    lam: Float[Tensor, "cameras problems"]


def _judged(
    optima: Optima,
    where: Int[Tensor, " optima"],
    status: Int[Tensor, " all"],
    shape: torch.Size,
    contradiction: float,
) -> Fused:
    """The optima certified, and those that stand entered among all problems, which have this shape."""
    problems, views, u = optima.problems, optima.views, optima.u
    certificate = solver.certify(views, u, optima.lam)
    surprise = solver.surprise(views, u).T
    ruled_out = ((surprise > 1 - contradiction) & problems.mask).sum(-1)
    status[where[2 * ruled_out >= problems.mask.sum(-1)]] = Status.CONTRADICTION
    status[where[~(certificate.relative <= CONVERGED)]] = Status.NOT_CONVERGED
    good = (status[where] == Status.FUSED).nonzero().squeeze(-1)
    where, solved, u = where[good], problems.subset(good), u[:, good]

    def entered(values: Tensor) -> Tensor:
        entries = values.new_full((len(status), *values.shape[1:]), torch.nan)
        entries[where] = values
        return entries.reshape(shape + values.shape[1:])

    return Fused(
        entered(solved.in_world(u)),
        entered(certificate.distance[good]),
        entered(certificate.subgradient[good]),
        entered(surprise[good].masked_fill(~solved.mask, torch.nan)),
        status.reshape(shape),
        solved,
        u,
    )

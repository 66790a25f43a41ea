"""One position from the predictions of several cameras that saw the same object, and perhaps from a plane."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.level import credible_level
from phd_exp.fusion.certificate import certify
from phd_exp.fusion.energy import energy
from phd_exp.fusion.fused import Fused, unfused
from phd_exp.fusion.moments import moments
from phd_exp.fusion.newton import minimise
from phd_exp.fusion.polish import polish
from phd_exp.fusion.pose import Plane, Pose
from phd_exp.fusion.problems import Problems
from phd_exp.fusion.status import Status
from phd_exp.fusion.views import Unknown, Views

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
    problems = Problems.posed(predictions, pose, plane, mask)
    result = unfused(problems.status(), problems.mask.shape[1])
    sound = (result.status == Status.FUSED).nonzero().squeeze(-1)
    part = problems.subset(sound)
    u, lam, seen = find_optimum(part.views())
    unseen = (~seen).nonzero().squeeze(-1)
    result.status[sound[unseen]] = _why_unseen(part.subset(unseen))
    kept = seen.nonzero().squeeze(-1)
    _fill(result, sound[kept], part.subset(kept), u[:, kept], lam[:, kept], contradiction)
    return result.reshaped(predictions.batch_shape[:-1])


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
        u[:, rest], lam[:, rest] = minimise(part, u[:, rest], least)
        seen[rest] = (part.seen(u[:, rest])[2] >= least).all(0)
    return u, lam, seen


def _why_unseen(problems: Problems) -> Int[Tensor, " problems"]:
    """Is it the plane, or have the cameras nothing in common anyway?"""
    status = torch.full_like(problems.mask[:, 0], int(Status.NO_COMMON_VIEW), dtype=torch.long)
    if problems.plane is not None and len(status) > 0:
        seen = find_optimum(problems.without_plane().views())[2]
        status[seen] = Status.PLANE_BEHIND_CAMERA
    return status


def _fill(
    result: Fused,
    where: Int[Tensor, " some"],
    problems: Problems,
    u: Unknown,
    lam: Float[Tensor, "cameras some"],
    contradiction: float,
) -> None:
    """Polish, certify and judge the optima of some problems, and enter those that stand."""
    views = problems.views()
    u, lam = polish(views, u, lam)
    certificate = certify(views, u, lam)
    surprise = _surprise(views, u).T
    ruled_out = ((surprise > 1 - contradiction) & problems.mask).sum(-1)
    status = torch.full_like(ruled_out, int(Status.FUSED))
    status[2 * ruled_out >= problems.mask.sum(-1)] = Status.CONTRADICTION
    status[~(certificate.relative <= CONVERGED)] = Status.NOT_CONVERGED
    result.status[where] = status
    good = (status == Status.FUSED).nonzero().squeeze(-1)
    where, problems, views = where[good], problems.subset(good), views.subset(good)
    mean, covariance = moments(views, u[:, good])
    D = problems.directions
    result.point[where] = problems.in_world(u[:, good])
    result.mean[where] = problems.in_world(mean)
    result.covariance[where] = D @ covariance.permute(2, 0, 1) @ D.mT
    result.certificate[where] = certificate.distance[good]
    result.subgradient[where] = certificate.subgradient[good]
    result.surprise[where] = surprise[good].masked_fill(~problems.mask, torch.nan)


def _surprise(views: Views, u: Unknown) -> Float[Tensor, "cameras problems"]:
    """Credible level of u in each view."""
    return credible_level(energy(views.seen(u), views.a) - views.a, views.a)

"""The two errors of the paper's tables, along the true viewing ray and across it, and the Mahalanobis distance."""

import torch
from jaxtyping import Float
from torch import Tensor

MILLIMETRES = 1000.0


def along_true_ray(xyz: Float[Tensor, "*batch 3"], estimate: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """v_par = (v . v^ / |v|^2) v: the projection of the estimate onto the true viewing ray, in metres."""
    return (xyz * estimate).sum(-1, keepdim=True) / xyz.square().sum(-1, keepdim=True) * xyz


def projected_error(xyz: Float[Tensor, "*batch 3"], estimate: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """|v^ - v_par|: the distance of the estimate from the true viewing ray, in metres.

    Examples:
        >>> xyz, estimate = torch.tensor([0.0, 0.0, 4.0]), torch.tensor([0.3, 0.4, 4.5])
        >>> float(projected_error(xyz, estimate)), float(depth_error(xyz, estimate))
        (0.5, 0.5)
    """
    return (estimate - along_true_ray(xyz, estimate)).norm(dim=-1)


def depth_error(xyz: Float[Tensor, "*batch 3"], estimate: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """| |v_par| - |v| |: the error along the true viewing ray, in metres."""
    return (along_true_ray(xyz, estimate).norm(dim=-1) - xyz.norm(dim=-1)).abs()


def distance_error(xyz: Float[Tensor, "*batch 3"], estimate: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """| |v^| - |v| |: the error of the distance from the camera, in metres.

    Source: ALE of MonoLoco (Bertoni et al. 2019, `monoloco/eval/eval_kitti.py`) is its mean.
    """
    return (estimate.norm(dim=-1) - xyz.norm(dim=-1)).abs()


def squared_mahalanobis(
    error: Float[Tensor, "*batch n"],
    covariance: Float[Tensor, "*batch n n"],
    along: Float[Tensor, "*#batch n k"] | None = None,
) -> Float[Tensor, "*batch"]:
    """e^T C^(-1) e, with expectation n if C is the covariance of e; NaN where C is singular or not finite.

    `along` restricts it to the components along k directions, the columns of a matrix; its expectation is then k.
    """
    if along is not None:
        error, covariance = (along.mT @ error[..., None]).squeeze(-1), along.mT @ covariance @ along
    solution, info = torch.linalg.solve_ex(covariance, error[..., None])
    distance = (error[..., None] * solution).sum((-2, -1))
    return torch.where(info == 0, distance, torch.nan)

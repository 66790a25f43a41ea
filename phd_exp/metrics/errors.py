"""The two columns of the paper's tables, error along the true viewing ray and across it; error against covariance."""

import torch
from jaxtyping import Float
from torch import Tensor

MILLIMETRES = 1000.0


def along_true_ray(
    xyz: Float[Tensor, "*batch 3"], estimate: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """The true position moved along its own viewing ray to where the estimate projects onto that ray.

    v_par = (v . v^ / |v|^2) v, in metres.
    """
    scale = (xyz * estimate).sum(-1, keepdim=True) / xyz.square().sum(-1, keepdim=True)
    return scale * xyz


def projected_error(
    xyz: Float[Tensor, "*batch 3"], estimate: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch"]:
    """|v^ - v_par|: the distance of the estimate from the true viewing ray, in metres."""
    return (estimate - along_true_ray(xyz, estimate)).norm(dim=-1)


def depth_error(
    xyz: Float[Tensor, "*batch 3"], estimate: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch"]:
    """| |v_par| - |v| |: the error along the true viewing ray, in metres."""
    return (along_true_ray(xyz, estimate).norm(dim=-1) - xyz.norm(dim=-1)).abs()


def squared_mahalanobis(
    error: Float[Tensor, "*batch n"],
    covariance: Float[Tensor, "*batch n n"],
    along: Float[Tensor, "*#batch n k"] | None = None,
) -> Float[Tensor, "*batch"]:
    """e^T C^(-1) e, of expectation n where C is the covariance of e; NaN where C is singular or not finite.

    Along k directions, the columns of a matrix, that of their components, of expectation k.
    """
    if along is not None:
        error, covariance = (along.mT @ error[..., None]).squeeze(-1), along.mT @ covariance @ along
    solution, info = torch.linalg.solve_ex(covariance, error[..., None])
    distance = (error[..., None] * solution).sum((-2, -1))
    return torch.where(info == 0, distance, torch.nan)

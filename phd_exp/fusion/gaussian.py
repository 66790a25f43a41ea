"""References for fusion: the average of the positions, and inverse-covariance weighting."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def average(
    positions: Float[Tensor, "*batch cameras 3"], mask: Bool[Tensor, "*batch cameras"] | None = None
) -> Float[Tensor, "*batch 3"]:
    """The mean over the cameras of positions in the world, in the same unit; NaN where all cameras are masked out."""
    if mask is None:
        return positions.mean(-2)
    # the position of a camera that is masked out may be NaN
    return torch.where(mask[..., None], positions, 0).sum(-2) / mask.sum(-1, keepdim=True)


def gaussian_fusion(
    means: Float[Tensor, "*batch cameras 3"], covariances: Float[Tensor, "*batch cameras 3 3"]
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3 3"]]:
    """Position and covariance of a product of Gaussians in the world: precisions add, means weighted by them.

    C = (sum C_i^(-1))^(-1) and v = C sum C_i^(-1) v_i, in the units of the means. Raises torch.linalg.LinAlgError
    if a covariance is singular.

    Source: inverse-covariance weighting; checked in tests/fusion/test_gaussian.py.
    """
    precisions = torch.linalg.inv(covariances)
    covariance = torch.linalg.inv(precisions.sum(-3))
    weighted = (precisions @ means[..., None]).sum(-3)
    return (covariance @ weighted).squeeze(-1), covariance

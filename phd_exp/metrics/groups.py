"""Worst-group calibration: the largest miscalibration over random groups of samples with similar predictions.

Groups of samples drawn blindly reveal nothing that all samples together do not. So a group is the first part of the
samples along a random direction in the ranks of what is predicted. A model that is right on average and wrong in
opposite ways in two regions is wrong in some of them. The largest of many distances is large by chance too: compare
it with that of calibrated predictions over the same groups, which accounts for their number and overlap.

Source: adversarial group calibration (Zhao et al., "Individual calibration with randomized forecasting", 2020).
"""

import torch
from jaxtyping import Float
from torch import Tensor

SHARES = torch.linspace(0.1, 1, 10)  # of all samples in a group
DIRECTIONS = 30
_LEVELS = torch.linspace(0.1, 0.9, 9)


def similar_groups(features: Float[Tensor, "samples features"]) -> Float[Tensor, "directions shares samples"]:
    """1 for the members of each group and 0 for others; the same for the same features."""
    random = torch.Generator().manual_seed(0)
    ranks = features.argsort(dim=0, stable=True).argsort(0).float()
    place = (ranks @ torch.randn(features.shape[1], DIRECTIONS, generator=random)).argsort(0).argsort(0)
    return (place.mT[:, None] < SHARES[:, None] * len(features)).float()


def worst_group(
    level: Float[Tensor, "*#batch samples"],
    groups: Float[Tensor, "directions shares samples"],
    weight: Float[Tensor, "*batch samples"],
) -> Float[Tensor, "*batch"]:
    """The largest mean |coverage(p) - p|, p = 0.1, ..., 0.9, over groups of a share, averaged over the shares.

    `level` is the credible level of each sample, which counts `weight` times.
    """
    weight = weight.float()[..., None]
    inside = weight * (level[..., None] <= _LEVELS)
    # one large product of matrices
    coverage = torch.tensordot(groups, inside, ([2], [-2])) / torch.tensordot(groups, weight, ([2], [-2]))
    return (coverage - _LEVELS).abs().mean(-1).amax(0).mean(0).double()

"""Samples sorted by a quantity: every measure of calibration is computed from them.

Samples with equal values form a group, so no result depends on the order of rows; a histogram is a coarser grouping.
Counts may have leading dimensions, one entry for each resample of a bootstrap.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Ordered:
    """Groups of samples in ascending order of a quantity.

    Args:
        points: the quantity, one value per group.
        count: number of samples in each group.
        sums: name of a column -> its sum over each group.
    """

    points: Float[Tensor, "*#batch groups"]
    count: Float[Tensor, "*batch groups"]
    sums: Mapping[str, Float[Tensor, "*batch groups"]]

    @property
    def total(self) -> Float[Tensor, "*batch 1"]:
        """The number of samples."""
        return self.count.sum(-1, keepdim=True)

    @property
    def up_to(self) -> Float[Tensor, "*batch groups"]:
        """The number of samples up to the end of each group."""
        return self.count.cumsum(-1)

    def share_up_to(self) -> Float[Tensor, "*batch groups"]:
        """The share of samples up to the end of each group: the empirical CDF at its point."""
        return self.up_to / self.total

    def mean(self, name: str) -> Float[Tensor, "*batch"]:
        """The mean of a column over all samples."""
        return self.sums[name].sum(-1) / self.count.sum(-1)

    def pooled(self, values: Float[Tensor, "*batch groups"], bins: int) -> Float[Tensor, "*batch bins"]:
        """The sum of values over bins of about equally many samples; the middle of a group decides its bin."""
        middle = (self.up_to - self.count / 2) / self.total
        return _pooled(values, (bins * middle.nan_to_num(0)).long().clamp_max(bins - 1), bins)


def in_order_of(
    quantity: Float[Tensor, " samples"],
    columns: Mapping[str, Float[Tensor, "... samples"]],
    weight: Float[Tensor, "*batch samples"] | None = None,
) -> Ordered:
    """Sort samples by a quantity and sum columns over equal values, each sample counted `weight` times (default 1).

    A column may have the leading dimensions of `weight`, for example if it is simulated several times.

    Raises ValueError for no samples, or for samples that are not finite.
    """
    for column in (quantity, *columns.values()):
        bad = int((~column.isfinite()).sum())
        if len(column) == 0 or bad:
            raise ValueError(
                f"samples: got {len(column)}, {bad} of them not finite; expected at least one, all finite"
            )
    quantity = quantity.double()
    if weight is None:
        weight = torch.ones_like(quantity)
    points, group = quantity.unique(return_inverse=True)
    sums = {name: _pooled(weight * column.double(), group, len(points)) for name, column in columns.items()}
    return Ordered(points, _pooled(weight, group, len(points)), sums)


def _pooled(values: Tensor, bin: Tensor, bins: int) -> Tensor:
    """The sum of values over each bin."""
    return values.new_zeros((*values.shape[:-1], bins)).scatter_add_(-1, bin.expand_as(values), values)

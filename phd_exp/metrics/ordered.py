"""Samples in the order of a quantity: the one thing that every measure of calibration is computed from.

Samples that are equal in the quantity form a group and stay together, so no result depends on the order of rows; a
histogram is a coarser grouping of the same kind. Counts may carry leading dimensions, one for each resample of a
bootstrap.
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
        points: the quantity, one value a group.
        count: how many samples a group has.
        sums: name of a column -> its sum over each group.
    """

    points: Float[Tensor, " groups"]
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

    def pooled(self, name: str, bins: int) -> Float[Tensor, "*batch bins"]:
        """The sum of a column over bins of about equally many samples; whole groups, each where its middle lies."""
        return _pooled(self.sums[name], self._bin(bins), bins)

    def pooled_count(self, bins: int) -> Float[Tensor, "*batch bins"]:
        """How many samples each of those bins has."""
        return _pooled(self.count, self._bin(bins), bins)

    def _bin(self, bins: int) -> Tensor:
        middle = (self.up_to - self.count / 2) / self.total
        return (bins * middle.nan_to_num(0)).long().clamp_max(bins - 1)


def in_order_of(
    quantity: Float[Tensor, " samples"],
    columns: Mapping[str, Float[Tensor, "... samples"]],
    weight: Float[Tensor, "*batch samples"] | None = None,
) -> Ordered:
    """Samples by a quantity, each counted `weight` times (once if None), with the sums of columns.

    A column may have the leading dimensions of `weight`, as one that is simulated several times.

    Raises ValueError where there are no samples or a number is not finite.
    """
    require_finite(quantity, *columns.values())
    quantity = quantity.double()
    if weight is None:
        weight = torch.ones_like(quantity)
    points, group = quantity.unique(return_inverse=True)

    def added(values: Tensor) -> Tensor:
        zeros = values.new_zeros((*values.shape[:-1], len(points)))
        return zeros.scatter_add_(-1, group.expand_as(values), values)

    sums = {name: added(weight * column.double()) for name, column in columns.items()}
    return Ordered(points, added(weight), sums)


def require_finite(*columns: Float[Tensor, "... samples"]) -> None:
    """Raise ValueError where there are no samples or a number is not finite."""
    for column in columns:
        finite = column.isfinite()
        if len(column) == 0 or not bool(finite.all()):
            raise ValueError(
                f"a measure needs samples, all of them finite; {int((~finite).sum())} of {len(column)} are not"
            )


def _pooled(values: Tensor, bin: Tensor, bins: int) -> Tensor:
    return values.new_zeros((*values.shape[:-1], bins)).scatter_add_(-1, bin, values)

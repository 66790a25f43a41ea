"""Percentile bootstrap over samples: how much a number would vary with another test set.

A resample is a row of counts: how often each sample was drawn. A statistic that takes counts sorts its samples once
and evaluates many resamples at a time.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

Number = TypeVar("Number")
Other = TypeVar("Other")

Statistic = Callable[[Mapping[str, Tensor], Tensor], Mapping[str, Tensor]]
"""Columns of shape (samples, ...) and counts (resamples, samples) -> name -> (resamples, *points)."""
_AT_ONCE = 10**6  # counts held in memory at a time


@dataclass(frozen=True)
class Interval(Generic[Number]):
    """A number with its 95 % interval, as floats or text; or the points of a curve with theirs, as tensors."""

    value: Number
    low: Number
    high: Number

    def each(self, change: Callable[[Number], Other]) -> "Interval[Other]":
        """The number and its bounds in another form, such as text."""
        return Interval(change(self.value), change(self.low), change(self.high))


def bands(
    statistic: Statistic, columns: Mapping[str, Float[Tensor, "samples ..."]], resamples: int, seed: int
) -> dict[str, Interval[Tensor]]:
    """95 % percentile intervals of scalars, and of curves at each of their points; equal for equal seeds.

    They do not test calibration: a distance from calibration cannot be negative and resampling adds noise to it, so
    close to perfect calibration all resamples may lie above the value. The interval is then extended to contain it.

    Raises ValueError for fewer than two samples, whose spread is unknown, or fewer than one resample.
    Source: Efron and Tibshirani, "An introduction to the bootstrap" (1993), chapter 13.

    Examples:
        >>> band = bands(means, {"x": torch.arange(100.0)}, resamples=200, seed=0)["x"]
        >>> float(band.value), bool(band.low < band.value < band.high)
        (49.5, True)
    """
    if len(next(iter(columns.values()), ())) < 2:
        raise ValueError("a bootstrap needs at least two samples for an interval")
    values, drawn = resampled(statistic, columns, resamples, seed)
    return {name: interval(value, drawn[name]) for name, value in values.items()}


def resampled(
    statistic: Statistic, columns: Mapping[str, Float[Tensor, "samples ..."]], resamples: int, seed: int
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """The statistic of the samples, and of each resample (along the first dimension).

    Tables with equal numbers of rows are resampled alike. Raises ValueError for no samples or no resamples.
    """
    n = len(next(iter(columns.values()), ()))
    if n == 0 or resamples < 1:
        raise ValueError(f"a bootstrap needs samples and resamples, not {n} and {resamples}")
    values = statistic(columns, torch.ones(1, n, dtype=torch.float64))
    generator = torch.Generator().manual_seed(seed)
    drawn: dict[str, list[Tensor]] = {name: [] for name in values}
    each = max(1, _AT_ONCE // n)
    for start in range(0, resamples, each):
        # how often each of n samples is drawn when n are drawn with replacement
        rows = torch.randint(n, (min(each, resamples - start), n), generator=generator)
        counts = torch.zeros(rows.shape, dtype=torch.float64)
        counts.scatter_add_(1, rows, torch.ones_like(counts))
        for name, found in statistic(columns, counts).items():
            drawn[name].append(found.double())
    return {name: value[0] for name, value in values.items()}, {k: torch.cat(v) for k, v in drawn.items()}


def interval(value: Tensor, drawn: Tensor) -> Interval[Tensor]:
    """The 95 % percentile interval of resampled values, extended to contain the value itself."""
    tails = torch.tensor([0.025, 0.975], dtype=torch.float64)
    # a resample may lack every sample that a point needs
    low, high = torch.nanquantile(drawn, tails, dim=0)
    return Interval(value, torch.minimum(low, value), torch.maximum(high, value))


def means(columns: Mapping[str, Tensor], counts: Tensor) -> dict[str, Tensor]:
    """The statistic "mean of each column"."""
    return {name: (counts @ column.double()) / counts.sum(-1) for name, column in columns.items()}

"""How far a number would move with another test set: percentile bootstrap over samples.

A resample is a row of counts, how often each sample was drawn. A statistic that takes counts sorts its samples once
and sees all resamples in one go.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

Statistic = Callable[[Mapping[str, Tensor], Tensor], Mapping[str, Tensor]]
"""Columns of shape (samples,) and counts (resamples, samples) -> name -> (resamples, *points)."""


@dataclass(frozen=True)
class Interval:
    """A statistic of the samples, and between which bounds it lies in most resamples."""

    value: Float[Tensor, "*points"]
    low: Float[Tensor, "*points"]
    high: Float[Tensor, "*points"]


def bands(
    statistic: Statistic,
    columns: Mapping[str, Float[Tensor, " samples"]],
    resamples: int,
    seed: int,
    confidence: float = 0.95,
) -> dict[str, Interval]:
    """Percentile intervals of scalars, and of curves at each of their points alone; the same for the same seed.

    A distance from calibration cannot be negative, and drawing with replacement adds noise to it: near perfect
    calibration all resamples may lie above the value. The interval is then stretched to hold it.

    Raises ValueError without samples, with fewer than one resample, or for a confidence outside (0, 1).
    Source: Efron and Tibshirani, "An introduction to the bootstrap" (1993), chapter 13.
    """
    n = len(next(iter(columns.values()), ()))
    if n == 0 or resamples < 1 or not 0 < confidence < 1:
        raise ValueError(
            f"a bootstrap needs samples and resamples, not {n} and {resamples}; {confidence=} in (0, 1)"
        )
    values = statistic(columns, torch.ones(1, n, dtype=torch.float64))
    drawn = statistic(columns, resample_counts(n, resamples, seed))
    tails = torch.tensor([(1 - confidence) / 2, (1 + confidence) / 2], dtype=torch.float64)
    return {name: _interval(value[0], drawn[name], tails) for name, value in values.items()}


def resample_counts(n: int, resamples: int, seed: int) -> Float[Tensor, "resamples n"]:
    """How often each of n samples is drawn when n are drawn with replacement, once a row."""
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.randint(n, (resamples, n), generator=generator)
    zeros = torch.zeros(resamples, n, dtype=torch.float64)
    return zeros.scatter_add_(1, drawn, torch.ones_like(zeros))


def _interval(value: Tensor, drawn: Tensor, tails: Tensor) -> Interval:
    # a resample may lack every sample that a point needs
    low, high = torch.nanquantile(drawn.double(), tails, dim=0)
    return Interval(value, torch.minimum(low, value), torch.maximum(high, value))

"""Calibration: are squared errors as large as predicted variances, and credible levels as frequent as they claim?

Credible levels and probability integral transforms (PIT: the predicted probability of a smaller depth) are uniform on
[0, 1] over the samples of a calibrated model, so both are held against the uniform law here.
"""

from dataclasses import asdict, dataclass
from typing import Any

import torch
from jaxtyping import Float
from scipy.stats import kstwo
from torch import Tensor

from phd_exp.metrics.ordered import Ordered, in_order_of, require_finite

FEWEST_POINTS = 5
"""Of a curve; a small test set narrows its window to draw at least this many independent ones."""


@dataclass(frozen=True)
class CalibrationCurve:
    """Predicted variance against mean squared error; a calibrated model lies on the identity."""

    predicted: Float[Tensor, " points"]
    empirical: Float[Tensor, " points"]
    window: int
    left_out: int
    """Samples whose variance or error was not finite, as an untrained network may predict."""

    def as_data(self) -> dict[str, Any]:
        """For JSON and for drawing: lists of numbers."""
        return asdict(self) | {"predicted": self.predicted.tolist(), "empirical": self.empirical.tolist()}


def calibration_curve(
    predicted_variance: Float[Tensor, " samples"], squared_error: Float[Tensor, " samples"], window: int
) -> CalibrationCurve:
    """Sort by predicted variance and average both over a sliding window of neighbours.

    The window holds `window` samples, or a fifth of the samples where there are fewer than five windows of
    them. A set of n samples gives n - window + 1 points, in the unit of the variance.

    Raises ValueError for a window below 1, or where no sample has a finite variance and error.
    Source: paper, section "Empirical error vs. estimated error" (window 200).
    """
    both = torch.stack([predicted_variance, squared_error]).double()
    finite = both[:, both.isfinite().all(dim=0)]
    if window < 1 or finite.numel() == 0:
        raise ValueError(f"a calibration curve needs finite samples and a window >= 1, not {window=}")
    window = max(1, min(window, finite.shape[1] // FEWEST_POINTS))
    ordered = finite[:, finite[0].argsort(stable=True)]
    # averages by pooling rather than by differences of running sums, which cancel over orders of magnitude
    predicted, empirical = torch.nn.functional.avg_pool1d(ordered[None], window, stride=1)[0]
    return CalibrationCurve(predicted, empirical, window, left_out=both.shape[1] - finite.shape[1])


def ence(
    predicted_variance: Float[Tensor, " samples"], squared_error: Float[Tensor, " samples"], bins: int
) -> Float[Tensor, ""]:
    """Expected normalised calibration error: the mean over bins of |RMV - RMSE| / RMV.

    Bins hold about equally many samples, sorted by predicted variance; samples of equal variance stay together, and
    bins count by their samples where they cannot be equal. Errors of n/bins samples scatter: a calibrated model is
    at about 0.4 sqrt((k - 1) bins/n) with the kurtosis k of its errors, not at zero.

    Raises ValueError for bins below 1, no samples, or samples that are not finite.
    Source: Levi et al., "Evaluating and calibrating uncertainty prediction in regression tasks" (2022).
    """
    if bins < 1:
        raise ValueError(f"bins must be at least 1, not {bins}")
    columns = {"variance": predicted_variance, "squared_error": squared_error}
    return ence_of(in_order_of(predicted_variance, columns), "variance", "squared_error", bins)


def ence_of(ordered: Ordered, variance: str, squared_error: str, bins: int) -> Float[Tensor, "*batch"]:
    """`ence` of samples in the order of their variance."""
    count = ordered.pooled_count(bins)
    ratio = ordered.pooled(squared_error, bins) / ordered.pooled(variance, bins)
    gap = (1 - ratio.sqrt()).abs().masked_fill(count == 0, 0)
    return (count * gap).sum(-1) / count.sum(-1)


def coverage(levels: Float[Tensor, " samples"], at: Float[Tensor, " points"]) -> Float[Tensor, " points"]:
    """The share of samples whose credible level is at most each of the levels asked for: their empirical CDF.

    Raises ValueError without samples, or with one that is not finite.
    """
    return coverage_of(in_order_of(levels, {}), at)


def coverage_of(ordered: Ordered, at: Float[Tensor, " points"]) -> Float[Tensor, "*batch points"]:
    """`coverage` of samples in the order of their levels."""
    share = torch.nn.functional.pad(ordered.share_up_to(), (1, 0))
    return share[..., torch.searchsorted(ordered.points, at.double(), right=True)]


def miscalibration_area(levels: Float[Tensor, " samples"]) -> Float[Tensor, ""]:
    """int_0^1 |coverage(p) - p| dp, exactly: coverage is a step function. 0 is perfect, 1/2 the worst.

    Raises ValueError without samples, or with one that is not finite.
    """
    return miscalibration_area_of(in_order_of(levels, {}))


def miscalibration_area_of(ordered: Ordered) -> Float[Tensor, "*batch"]:
    """`miscalibration_area` of samples in the order of their levels."""
    share = torch.nn.functional.pad(ordered.share_up_to(), (1, 0))
    edges = torch.nn.functional.pad(torch.nn.functional.pad(ordered.points, (1, 0)), (0, 1), value=1.0)
    upper, lower = edges[1:] - share, edges[:-1] - share  # p - coverage at both ends of each step
    return (upper * upper.abs() - lower * lower.abs()).sum(-1) / 2


def overconfidence(levels: Float[Tensor, " samples"]) -> Float[Tensor, ""]:
    """int_0^1 (p - coverage(p)) dp, the mean level minus 1/2: above 0 too certain, below 0 too cautious.

    Of a PIT it is the bias: above 0 depths are predicted too small.
    Raises ValueError without samples, or with one that is not finite.
    """
    require_finite(levels)
    return levels.double().mean() - 0.5


def pit_histogram(pit: Float[Tensor, " samples"], bins: int) -> Float[Tensor, " bins"]:
    """The share of samples in each of equal bins of [0, 1], times the number of bins: 1 where calibrated.

    A U says too certain, a hump too cautious, a slope biased.
    Raises ValueError without samples, or with one that is not finite.
    """
    require_finite(pit)
    return torch.histc(pit.double(), bins, min=0, max=1) * bins / len(pit)


@dataclass(frozen=True)
class UniformityTest:
    """Kolmogorov and Smirnov's distance from the uniform law, and how probable a larger one is under it."""

    statistic: float
    pvalue: float


def uniformity_test(levels: Float[Tensor, " samples"]) -> UniformityTest:
    """Are levels, or PITs, uniform on [0, 1]? The largest |coverage(p) - p|, with its exact two-sided p-value.

    Raises ValueError without samples, or with one that is not finite.
    """
    distance = float(uniform_distance_of(in_order_of(levels, {})))
    return UniformityTest(distance, float(kstwo.sf(distance, len(levels))))


def uniform_distance_of(ordered: Ordered) -> Float[Tensor, "*batch"]:
    """max |coverage(p) - p| over p, of samples in the order of their levels."""
    after = ordered.share_up_to()
    before = after - ordered.count / ordered.total
    gaps = torch.maximum(after - ordered.points, ordered.points - before)
    return gaps.amax(-1)

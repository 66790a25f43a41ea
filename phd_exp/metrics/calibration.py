"""Calibration: squared errors against predicted variances, and credible levels against the uniform law.

Credible levels and probability integral transforms (PIT: the predicted probability of a smaller depth) of a
calibrated model are uniform on [0, 1]. The functions of levels take a tensor, or samples in the order of their
levels; with an `Ordered` they return one number for each of its leading dimensions. All raise ValueError for no
samples, or for samples that are not finite.
"""

from dataclasses import asdict, dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.metrics.ordered import Ordered, in_order_of

FEWEST_POINTS = 5  # independent points of a curve; the window of a small test set is narrowed to give as many


@dataclass(frozen=True)
class CalibrationCurve:
    """Predicted variance against mean squared error; a calibrated model lies on the identity.

    `left_out` counts samples whose variance or error is not finite, as an untrained network may predict.
    """

    predicted: Float[Tensor, " points"]
    empirical: Float[Tensor, " points"]
    window: int
    left_out: int

    def as_data(self) -> dict[str, Any]:
        """The curve as lists of numbers, for JSON and for drawing."""
        return asdict(self) | {"predicted": self.predicted.tolist(), "empirical": self.empirical.tolist()}


def calibration_curve(
    predicted_variance: Float[Tensor, " samples"], squared_error: Float[Tensor, " samples"], window: int
) -> CalibrationCurve:
    """Sort by predicted variance and average both over a sliding window of neighbours.

    The window holds `window` samples, but at most a fifth of all samples. n samples give n - window + 1 points, in
    the unit of the variance.

    Raises ValueError for a window below 1, or if no sample has a finite variance and error.
    Source: paper, section "Empirical error vs. estimated error" (window 200).

    Examples:
        >>> curve = calibration_curve(torch.tensor([4.0, 1.0]), torch.tensor([5.0, 2.0]), window=200)
        >>> curve.predicted.tolist(), curve.empirical.tolist(), curve.window
        ([1.0, 4.0], [2.0, 5.0], 1)
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


def ence_of(ordered: Ordered, variance: str, squared_error: str, bins: int) -> Float[Tensor, "*batch"]:
    """Expected normalised calibration error: the mean over bins of |RMV - RMSE| / RMV.

    Samples are in the order of their variance, and bins hold about equally many of them. Those of equal variance
    share a bin, and each bin is weighted by its samples. A calibrated model has about 0.4 sqrt((k - 1) bins/n), k the
    kurtosis of its errors, because errors of n/bins samples scatter.

    Raises ValueError for bins below 1.
    Source: Levi et al., "Evaluating and calibrating uncertainty prediction in regression tasks" (2022).
    """
    if bins < 1:
        raise ValueError(f"bins must be at least 1, not {bins}")
    count = ordered.pooled(ordered.count, bins)
    ratio = ordered.pooled(ordered.sums[squared_error], bins) / ordered.pooled(ordered.sums[variance], bins)
    gap = (1 - ratio.sqrt()).abs().masked_fill(count == 0, 0)
    return (count * gap).sum(-1) / count.sum(-1)


Levels = Float[Tensor, " samples"] | Ordered


def _in_order(levels: Levels) -> Ordered:
    return levels if isinstance(levels, Ordered) else in_order_of(levels, {})


def coverage(levels: Levels, at: Float[Tensor, " points"]) -> Float[Tensor, "*batch points"]:
    """The share of samples whose credible level is at most each value of `at`: their empirical CDF.

    Examples:
        >>> coverage(torch.tensor([0.2, 0.4, 0.6, 0.8]), torch.tensor([0.5, 0.9])).tolist()
        [0.5, 1.0]
    """
    ordered = _in_order(levels)
    share = torch.nn.functional.pad(ordered.share_up_to(), (1, 0))
    return share[..., torch.searchsorted(ordered.points, at.double(), right=True)]


def miscalibration_area(levels: Levels) -> Float[Tensor, "*batch"]:
    """int_0^1 |coverage(p) - p| dp, exactly: coverage is a step function. 0 is the best value, 1/2 the worst.

    Examples:
        >>> float(miscalibration_area(torch.tensor([0.5])))
        0.25
    """
    ordered = _in_order(levels)
    share = torch.nn.functional.pad(ordered.share_up_to(), (1, 0))
    edges = torch.nn.functional.pad(torch.nn.functional.pad(ordered.points, (1, 0)), (0, 1), value=1.0)
    upper, lower = edges[..., 1:] - share, edges[..., :-1] - share  # p - coverage at both ends of each step
    return (upper * upper.abs() - lower * lower.abs()).sum(-1) / 2


def overconfidence(levels: Levels) -> Float[Tensor, "*batch"]:
    """int_0^1 (p - coverage(p)) dp, the mean level minus 1/2: positive if overconfident, negative if underconfident.

    Of a PIT it is the bias: positive if depths are predicted too small.
    """
    ordered = _in_order(levels)
    return (ordered.count * ordered.points).sum(-1) / ordered.count.sum(-1) - 0.5


def uniform_distance(levels: Levels) -> Float[Tensor, "*batch"]:
    """max |coverage(p) - p| over p: the statistic of the Kolmogorov-Smirnov test, as of `scipy.stats.kstest`."""
    ordered = _in_order(levels)
    after = ordered.share_up_to()
    before = after - ordered.count / ordered.total
    return torch.maximum(after - ordered.points, ordered.points - before).amax(-1)

"""Calibration curves: is the squared error as large as the predicted variance says?"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

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

"""The curves that are drawn of a table of predictions, for all resamples of a bootstrap at once."""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.metrics.calibration import CalibrationCurve, calibration_curve, coverage_of
from phd_exp.metrics.calibration_scores import MILLIRADIANS, ordered
from phd_exp.metrics.errors import MILLIMETRES
from phd_exp.metrics.scores import risk_at

STEPS = 100
"""Of coverage, PIT and risk; a calibration curve has from as many to twice as many points."""
UNITS = {"depth": MILLIMETRES, "projected": MILLIRADIANS}


def abscissae(columns: Mapping[str, Float[Tensor, " samples"]], window: int) -> dict[str, Tensor]:
    """Where the `curves` of these samples are measured: name -> (points,)."""
    shares = torch.linspace(0, 1, STEPS + 1, dtype=torch.float64)
    x = {"coverage": shares, "depth_pit": shares}
    for name in UNITS:
        x[f"{name}_risk_coverage"] = shares[1:]
        curve = _calibration(columns, name, window)
        x[f"{name}_calibration"] = curve.predicted[:: _stride(len(curve.predicted))]
    return x


def curves(
    columns: Mapping[str, Float[Tensor, " samples"]],
    weight: Float[Tensor, "resamples samples"],
    window: int,
) -> dict[str, Tensor]:
    """Name -> (resamples, points), each sample counted `weight` times.

    `depth_calibration`, `projected_calibration`: mean squared error over the windows of `calibration_curve`;
    `coverage`, `depth_pit`: share of samples up to a credible level, a PIT; `depth_risk_coverage` (millimetres),
    `projected_risk_coverage` (thousandths): mean error of the share of samples with the smallest variance.

    Raises ValueError without samples, or with one that is not finite.
    """
    orders, x = ordered(columns, weight), abscissae(columns, window)
    y = {
        "coverage": coverage_of(orders["by_level"], x["coverage"]),
        "depth_pit": coverage_of(orders["by_depth_pit"], x["depth_pit"]),
    }
    for name, unit in UNITS.items():
        risk = risk_at(orders[f"{name}_by_variance"], f"{name}_error", x[f"{name}_risk_coverage"])
        y[f"{name}_risk_coverage"] = unit * risk
        y[f"{name}_calibration"] = _window_means(columns, name, weight, window)
    return y


def _calibration(columns: Mapping[str, Tensor], name: str, window: int) -> CalibrationCurve:
    return calibration_curve(columns[f"{name}_variance"], columns[f"{name}_squared_error"], window)


def _window_means(columns: Mapping[str, Tensor], name: str, weight: Tensor, window: int) -> Tensor:
    """The mean squared error of each window, which stays where it is while the samples in it are drawn anew."""
    curve = _calibration(columns, name, window)
    order = columns[f"{name}_variance"].double().argsort(stable=True)
    counts = weight[:, order]
    errors = counts * columns[f"{name}_squared_error"].double()[order]
    stride = _stride(len(curve.predicted))
    pooled_errors, pooled_counts = torch.nn.functional.avg_pool1d(
        torch.stack([errors, counts]), curve.window, stride
    )
    return pooled_errors / pooled_counts


def _stride(points: int) -> int:
    return max(1, points // STEPS)

"""Scores and curves of a probabilistic prediction, all from samples in the order of a few recorded columns."""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.metrics import calibration
from phd_exp.metrics.errors import MILLIMETRES
from phd_exp.metrics.ordered import Ordered, in_order_of
from phd_exp.metrics.scores import risk_at, risk_coverage

COLUMNS = (
    "depth_variance",
    "depth_squared_error",
    "projected_variance",
    "projected_squared_error",
    "level",
    "depth_pit",
    "depth_crps",
)
"""One number per sample: variances and squared errors (m^2; no unit), level, PIT and CRPS (m) of depth."""

MILLIRADIANS = 1000.0  # unit of x/z and y/z, which are angles where they are small
MOST_BINS = 10
FEWEST_IN_A_BIN = 100
WINDOW = 200  # samples averaged in a calibration curve, as in the paper
STEPS = 100  # points of coverage, PIT and risk; a calibration curve has from as many to twice as many
UNITS = {"depth": MILLIMETRES, "projected": MILLIRADIANS}


ORDERS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "depth_by_variance": ("depth_variance", ("depth_variance", "depth_squared_error", "depth_error")),
    "depth_by_error": ("depth_squared_error", ("depth_error",)),
    "projected_by_variance": (
        "projected_variance",
        ("projected_variance", "projected_squared_error", "projected_error"),
    ),
    "projected_by_error": ("projected_squared_error", ("projected_error",)),
    "by_level": ("level", ("depth_crps",)),
    "by_depth_pit": ("depth_pit", ()),
}
"""Name -> the column that samples are sorted by, and the columns that are summed over neighbours."""


def exact_scores(columns: Mapping[str, Float[Tensor, " samples"]]) -> dict[str, float]:
    """`calibration_scores` of the samples that are finite, and `left_out`, the number of the others.

    Without a finite sample the scores are NaN.
    """
    finite = torch.stack([columns[name].isfinite() for name in COLUMNS]).all(dim=0)
    weight = None
    if bool(finite.any()):
        columns = {name: columns[name][finite] for name in COLUMNS}
    else:
        weight = torch.zeros(1, dtype=torch.float64)
        columns = {name: weight for name in COLUMNS}
    scores = calibration_scores(ordered(columns, weight))
    return {name: float(score) for name, score in scores.items()} | {"left_out": float((~finite).sum())}


def ordered(
    columns: Mapping[str, Float[Tensor, " samples"]], weight: Float[Tensor, "*batch samples"] | None = None
) -> dict[str, Ordered]:
    """Samples in each of the `ORDERS`, each counted `weight` times. Raises ValueError as `in_order_of` does."""
    values = {name: columns[name].double() for name in COLUMNS}
    values |= {f"{name}_error": values[f"{name}_squared_error"].sqrt() for name in UNITS}
    return {
        name: in_order_of(values[by], {summed: values[summed] for summed in sums}, weight)
        for name, (by, sums) in ORDERS.items()
    }


def calibration_scores(orders: Mapping[str, Ordered]) -> dict[str, Float[Tensor, "*batch"]]:
    """Every score of samples in the `ORDERS`; 0 is best unless stated otherwise.

    - `depth_ence`, `projected_ence`: expected normalised calibration error (`ence_of`) in at most 10 bins.
    - `miscalibration_area` of the credible levels, `depth_pit_area` of the PIT of depth: int |coverage(p) - p| dp.
    - `overconfidence`: mean credible level minus 1/2; negative if underconfident.
    - `depth_pit_ks`: Kolmogorov-Smirnov distance of the PIT of depth from the uniform law.
    - `depth_crps_mm`: mean continuous ranked probability score of depth, millimetres.
    - `depth_sharpness_mm`, `projected_sharpness_mrad`: root mean square of the predicted standard deviation of z, and
      of x/z and y/z each, in thousandths. Small means sharp, not correct.
    - `depth_risk_coverage_area` (mm), `projected_risk_coverage_area` (thousandths), and `..._excess`: whether
      predicted variance ranks the errors (`risk_coverage`). An excess of 0 is perfect, 1 no better than chance.
    """
    level, pit = orders["by_level"], orders["by_depth_pit"]
    scores = {
        "miscalibration_area": calibration.miscalibration_area(level),
        "overconfidence": calibration.overconfidence(level),
        "depth_pit_area": calibration.miscalibration_area(pit),
        "depth_pit_ks": calibration.uniform_distance(pit),
        "depth_crps_mm": MILLIMETRES * level.mean("depth_crps"),
        "depth_sharpness_mm": MILLIMETRES * orders["depth_by_variance"].mean("depth_variance").sqrt(),
        "projected_sharpness_mrad": MILLIRADIANS
        * (orders["projected_by_variance"].mean("projected_variance") / 2).sqrt(),
    }
    for name, unit in UNITS.items():
        by_variance, by_error = orders[f"{name}_by_variance"], orders[f"{name}_by_error"]
        bins = ence_bins(by_variance)
        scores[f"{name}_ence"] = calibration.ence_of(by_variance, f"{name}_variance", f"{name}_squared_error", bins)
        area, scores[f"{name}_risk_coverage_excess"] = risk_coverage(by_variance, by_error, f"{name}_error")
        scores[f"{name}_risk_coverage_area"] = unit * area
    return scores


def ence_bins(samples: Ordered) -> int:
    """As many bins as hold 100 samples each, from one to ten."""
    return max(1, min(MOST_BINS, int(samples.total.max()) // FEWEST_IN_A_BIN))


def abscissae(columns: Mapping[str, Float[Tensor, " samples"]]) -> dict[str, Tensor]:
    """The x of each of the `curves`: name -> (points,)."""
    shares = torch.linspace(0, 1, STEPS + 1, dtype=torch.float64)
    x = {"coverage": shares, "depth_pit": shares}
    for name in UNITS:
        x[f"{name}_risk_coverage"] = shares[1:]
        curve, stride = _calibration(columns, name)
        x[f"{name}_calibration"] = curve.predicted[::stride]
    return x


def curves(
    columns: Mapping[str, Float[Tensor, " samples"]], weight: Float[Tensor, "resamples samples"]
) -> dict[str, Tensor]:
    """The y of each curve, each sample counted `weight` times: name -> (resamples, points).

    `depth_calibration`, `projected_calibration`: mean squared error over the windows of `calibration_curve`;
    `coverage`, `depth_pit`: share of samples up to a credible level, a PIT; `depth_risk_coverage` (millimetres),
    `projected_risk_coverage` (thousandths): mean error of the share of samples with the smallest variance.

    Raises ValueError for no samples, or for samples that are not finite.
    """
    orders, x = ordered(columns, weight), abscissae(columns)
    y = {
        "coverage": calibration.coverage(orders["by_level"], x["coverage"]),
        "depth_pit": calibration.coverage(orders["by_depth_pit"], x["depth_pit"]),
    }
    for name, unit in UNITS.items():
        risk = risk_at(orders[f"{name}_by_variance"], f"{name}_error", x[f"{name}_risk_coverage"])
        y[f"{name}_risk_coverage"] = unit * risk
        y[f"{name}_calibration"] = _window_means(columns, name, weight)
    return y


def _calibration(columns: Mapping[str, Tensor], name: str) -> tuple[calibration.CalibrationCurve, int]:
    """The curve, of whose points every n-th is kept, and n."""
    variance, squared_error = columns[f"{name}_variance"], columns[f"{name}_squared_error"]
    curve = calibration.calibration_curve(variance, squared_error, WINDOW)
    return curve, max(1, len(curve.predicted) // STEPS)


def _window_means(columns: Mapping[str, Tensor], name: str, weight: Tensor) -> Tensor:
    """The mean squared error of each window of `calibration_curve`, whose samples are drawn anew."""
    curve, stride = _calibration(columns, name)
    order = columns[f"{name}_variance"].double().argsort(stable=True)
    counts = weight[:, order]
    errors = counts * columns[f"{name}_squared_error"].double()[order]
    pooled_errors, pooled_counts = torch.nn.functional.avg_pool1d(torch.stack([errors, counts]), curve.window, stride)
    return pooled_errors / pooled_counts

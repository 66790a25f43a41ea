"""The scores by which a probabilistic prediction is judged, all from samples in the order of a few of its columns."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.metrics.calibration import ence_of, miscalibration_area_of, uniform_distance_of
from phd_exp.metrics.errors import MILLIMETRES
from phd_exp.metrics.ordered import Ordered, in_order_of
from phd_exp.metrics.scores import risk_coverage_of

COLUMNS = (
    "depth_variance",
    "depth_squared_error",
    "projected_variance",
    "projected_squared_error",
    "level",
    "depth_pit",
    "depth_crps",
)
"""One number a sample: variances and squared errors (m^2; without unit), level, PIT and CRPS (m) of depth."""

MILLIRADIANS = 1000.0
"""Of x/z and y/z, which are angles where they are small."""
MOST_BINS = 10
FEWEST_IN_A_BIN = 100


@dataclass(frozen=True)
class Order:
    """Samples in the order of one column, with what is summed over neighbours."""

    by: str
    sums: tuple[str, ...] = ()


ORDERS = {
    "depth_by_variance": Order("depth_variance", ("depth_variance", "depth_squared_error", "depth_error")),
    "depth_by_error": Order("depth_squared_error", ("depth_error",)),
    "projected_by_variance": Order(
        "projected_variance", ("projected_variance", "projected_squared_error", "projected_error")
    ),
    "projected_by_error": Order("projected_squared_error", ("projected_error",)),
    "by_level": Order("level", ("depth_crps",)),
    "by_depth_pit": Order("depth_pit"),
}


def with_errors(columns: Mapping[str, Float[Tensor, " samples"]]) -> dict[str, Float[Tensor, " samples"]]:
    """The columns in float64, and the errors |z - E[z]| and |(x, y)/z - mu_xy| beside their squares."""
    double = {name: columns[name].double() for name in COLUMNS}
    errors = {f"{name}_error": double[f"{name}_squared_error"].sqrt() for name in ("depth", "projected")}
    return double | errors


def finite_rows(columns: Mapping[str, Float[Tensor, " samples"]]) -> Tensor:
    """Which samples have all columns finite: of shape (samples,), bool."""
    return torch.stack([columns[name].isfinite() for name in COLUMNS]).all(dim=0)


def exact_scores(columns: Mapping[str, Float[Tensor, " samples"]]) -> dict[str, float]:
    """`calibration_scores` of the finite samples, and how many were `left_out`; NaN where none is left."""
    finite = finite_rows(columns)
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
    values = with_errors(columns)
    return {
        name: in_order_of(values[order.by], {summed: values[summed] for summed in order.sums}, weight)
        for name, order in ORDERS.items()
    }


def calibration_scores(orders: Mapping[str, Ordered]) -> dict[str, Float[Tensor, "*batch"]]:
    """Every score of samples in the `ORDERS`, 0 best unless said otherwise.

    - `depth_ence`, `projected_ence`: expected normalised calibration error (`ence`) in at most 10 bins.
    - `miscalibration_area` of the credible levels, `depth_pit_area` of the PIT of depth: int |coverage(p) - p| dp.
    - `overconfidence`: mean credible level minus 1/2; negative where too cautious.
    - `depth_pit_ks`: Kolmogorov and Smirnov's distance of the PIT of depth from the uniform law.
    - `depth_crps_mm`: mean continuous ranked probability score of depth, millimetres.
    - `depth_sharpness_mm`, `projected_sharpness_mrad`: root mean square of the predicted standard deviation of z, and
      of x/z and y/z each, in thousandths. Small is sharp, whether right or not.
    - `depth_risk_coverage_area` (mm), `projected_risk_coverage_area` (thousandths), and `..._excess`: does predicted
      variance find the large errors (`risk_coverage`)? An excess of 0 is perfect, 1 no better than chance.
    """
    level, pit = orders["by_level"], orders["by_depth_pit"]
    scores = {
        "miscalibration_area": miscalibration_area_of(level),
        "overconfidence": (level.count * level.points).sum(-1) / level.count.sum(-1) - 0.5,
        "depth_pit_area": miscalibration_area_of(pit),
        "depth_pit_ks": uniform_distance_of(pit),
        "depth_crps_mm": MILLIMETRES * level.mean("depth_crps"),
        "depth_sharpness_mm": MILLIMETRES * orders["depth_by_variance"].mean("depth_variance").sqrt(),
        "projected_sharpness_mrad": MILLIRADIANS
        * (orders["projected_by_variance"].mean("projected_variance") / 2).sqrt(),
    }
    for name, unit in (("depth", MILLIMETRES), ("projected", MILLIRADIANS)):
        by_variance, by_error = orders[f"{name}_by_variance"], orders[f"{name}_by_error"]
        scores[f"{name}_ence"] = ence_of(
            by_variance, f"{name}_variance", f"{name}_squared_error", ence_bins(by_variance)
        )
        curve = risk_coverage_of(by_variance, by_error, f"{name}_error")
        scores[f"{name}_risk_coverage_area"] = unit * curve.area
        scores[f"{name}_risk_coverage_excess"] = curve.excess
    return scores


def ence_bins(samples: Ordered) -> int:
    """As many bins as hold 100 samples each, at least one and at most ten."""
    return max(1, min(MOST_BINS, int(samples.total.max()) // FEWEST_IN_A_BIN))

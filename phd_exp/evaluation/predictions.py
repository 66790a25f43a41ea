"""Measures a table of predictions: scores, curves and strata with bootstrap intervals; recalibrates it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import pyarrow as pa
import torch
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.columns import PARAMETERS, distribution_columns, draws, from_columns
from phd_exp.distributions.temperature import Temperature
from phd_exp.evaluation.parquet import Columns, arrays, read_table
from phd_exp.evaluation.point_errors import SEED
from phd_exp.evaluation.reference import Band, calibrated_reference
from phd_exp.metrics.bootstrap import Interval, Statistic, bands, interval, resampled
from phd_exp.metrics.calibration import CalibrationCurve, calibration_curve
from phd_exp.metrics.calibration_scores import COLUMNS, calibration_scores, ordered
from phd_exp.metrics.curves import abscissae, curves
from phd_exp.metrics.errors import MILLIMETRES
from phd_exp.metrics.scores import DRAWS, energy_score
from phd_exp.metrics.strata import strata
from phd_exp.records.errors import RunError
from phd_exp.records.runs import RunFolder

ERRORS = ("projected_error_mm", "depth_error_mm")
OF_A_DISTRIBUTION = (*COLUMNS, *ERRORS, "nll", "energy_score")
XYZ = ("x", "y", "z")
QUANTITIES: Mapping[str, tuple[str, str, tuple[float, ...] | int]] = {
    "visibility": ("visibility", "", (0.0, 0.25, 0.5, 0.75, 0.95, 1.0)),
    "truncation": ("truncation", "", (0.0, 0.05, 0.25, 0.5, 1.0)),
    "depth": ("z", "m", 4),
    "focal length": ("f", "px", 4),
}
"""Quantity of the strata -> its column, its unit, and edges or a number of equal parts.

The true depth is what is predicted: even calibrated predictions are not calibrated among samples chosen by it.
"""


@dataclass(frozen=True)
class Curve:
    """Points of a curve, and the 95 % bootstrap interval of each y."""

    x: list[float]
    y: list[float]
    low: list[float]
    high: list[float]


@dataclass(frozen=True)
class Stratum:
    """The scores of a part of the samples."""

    quantity: str
    label: str
    n: int
    scores: dict[str, Band]


@dataclass(frozen=True)
class Evaluation:
    """A table of predictions, measured; `left_out` further samples had a number that is not finite.

    Attributes:
        scores: of a distribution `calibration_scores` and the means of `nll` (nats) and `energy_score_mm`; of a point
            estimate too the means of `projected_error_mm` and `depth_error_mm`.
        reference: of each score that is a distance from calibration, the median and the 95 % interval that calibrated
            predictions with the same uncertainties have (`calibrated_reference`): such a distance is never zero.
        curves: `metrics.curves.curves`; x is the predicted variance, credible level, PIT, or share of samples kept.
        resampled: each score on the same resampled test images for every run that has as many of them.
    """

    n: int
    scores: dict[str, Band]
    curves: dict[str, Curve]
    strata: list[Stratum]
    left_out: int
    reference: dict[str, Band] = field(default_factory=dict)
    resampled: dict[str, list[float]] = field(default_factory=dict)


def evaluate(table: pa.Table | Columns, window: int = 200, resamples: int = 200) -> Evaluation:
    """Measure predictions of a distribution.

    Raises RunError where a column is missing, or where no sample has all of them finite.
    """
    columns, left_out = _finite(table, OF_A_DISTRIBUTION, PARAMETERS)
    parameters = set(PARAMETERS) <= columns.keys()
    x = abscissae(columns, window)
    intervals = bands(partial(curves, window=window), columns, resamples, SEED)
    scores, drawn = _scores(_distribution_scores, columns, resamples)
    return Evaluation(
        n=len(columns["nll"]),
        scores=scores,
        curves={name: _curve(x[name], interval) for name, interval in intervals.items()},
        strata=_strata(_distribution_scores, columns, resamples),
        left_out=left_out,
        reference=calibrated_reference(_distribution(columns)) if parameters else {},
        resampled=drawn,
    )


def evaluate_points(table: pa.Table | Columns, resamples: int = 200) -> Evaluation:
    """Measure predictions of a point alone: its errors, no curves. Raises RunError as `evaluate` does."""
    columns, left_out = _finite(table, ERRORS)
    scores, drawn = _scores(_point_scores, columns, resamples)
    return Evaluation(
        n=len(columns[ERRORS[0]]),
        scores=scores,
        curves={},
        strata=_strata(_point_scores, columns, resamples),
        left_out=left_out,
        resampled=drawn,
    )


def fit_temperature(held_out_table: pa.Table | Columns) -> Temperature:
    """The temperatures that fit predictions of samples that were held out of training.

    Raises RunError where a column is missing, or where none fits.
    """
    columns, _ = _finite(held_out_table, (*PARAMETERS, *XYZ))
    try:
        return Temperature.fit(_distribution(columns), _positions(columns))
    except ValueError as error:
        raise RunError(f"predictions: no temperature fits them ({error})") from None


def held_out_temperature(folder: RunFolder) -> Temperature:
    """The temperatures that fit a run's recorded predictions of held-out samples.

    Raises RunError where they cannot be read, and as `fit_temperature` does.
    """
    return fit_temperature(read_table(folder.held_out))


def recalibrated(table: pa.Table | Columns, temperature: Temperature) -> dict[str, np.ndarray]:
    """The same columns for A / projected and a / depth: estimates of the mode stay, all that is uncertain changes.

    Samples whose parameters are not finite are dropped. Raises RunError where a column is missing, or where no sample
    has all of them finite.
    """
    arrays = _arrays(table, (*PARAMETERS, *XYZ))
    columns = {name: _tensor(arrays[name]) for name in (*PARAMETERS, *XYZ)}
    finite = _all_finite(columns, tuple(columns))
    columns = {name: column[finite] for name, column in columns.items()}
    distribution, xyz = temperature.apply(_distribution(columns)), _positions(columns)
    changed = distribution_columns(distribution, xyz)
    changed["energy_score"] = energy_score(draws(distribution, DRAWS, SEED), xyz)
    kept = {name: array[finite.numpy()] for name, array in arrays.items()}
    return kept | {name: column.numpy() for name, column in changed.items()}


def recalibrated_depth_curve(folder: RunFolder, temperature: Temperature, window: int) -> CalibrationCurve:
    """Of a run's test samples, predicted at these temperatures; square metres.

    Raises RunError where they cannot be read.
    """
    table = recalibrated(read_table(folder.predictions), temperature)
    variance, squared_error = (_tensor(table[f"depth_{name}"]) for name in ("variance", "squared_error"))
    return calibration_curve(variance, squared_error, window)


def _distribution_scores(columns: Mapping[str, Tensor], weight: Tensor) -> dict[str, Tensor]:
    energy = {"energy_score_mm": MILLIMETRES * _mean(columns["energy_score"], weight)}
    nll = {"nll": _mean(columns["nll"], weight)}
    return _point_scores(columns, weight) | nll | energy | calibration_scores(ordered(columns, weight))


def _point_scores(columns: Mapping[str, Tensor], weight: Tensor) -> dict[str, Tensor]:
    return {name: _mean(columns[name], weight) for name in ERRORS}


def _mean(column: Tensor, weight: Tensor) -> Tensor:
    return (weight * column).sum(-1) / weight.sum(-1)


def _scores(
    statistic: Statistic, columns: Mapping[str, Tensor], resamples: int
) -> tuple[dict[str, Band], dict[str, list[float]]]:
    values, drawn = resampled(statistic, columns, resamples, SEED)
    scores = {name: band_of(interval(value, drawn[name])) for name, value in values.items()}
    return scores, {name: values.tolist() for name, values in drawn.items()}


def band_of(found: Interval) -> Band:
    """An interval of one number."""
    return Band(float(found.value), float(found.low), float(found.high))


def _curve(x: Tensor, interval: Interval) -> Curve:
    return Curve(x.tolist(), interval.value.tolist(), interval.low.tolist(), interval.high.tolist())


def _strata(statistic: Statistic, columns: Mapping[str, Tensor], resamples: int) -> list[Stratum]:
    found = []
    for quantity, (column, unit, edges) in QUANTITIES.items():
        if column not in columns:
            continue
        for stratum in strata(quantity, columns[column], edges, unit):
            part = {name: values[stratum.mask] for name, values in columns.items()}
            scores, _ = _scores(statistic, part, resamples)
            found.append(Stratum(quantity, stratum.label, int(stratum.mask.sum()), scores))
    return found


def _finite(
    table: pa.Table | Columns, names: tuple[str, ...], welcome: tuple[str, ...] = ()
) -> tuple[dict[str, Tensor], int]:
    """These columns and the welcome ones, of samples where they are finite, with the strata; how many are not."""
    columns = _arrays(table, names)
    names += tuple(name for name in welcome if name in columns)
    of_strata = [column for column, _, _ in QUANTITIES.values() if column in columns]
    tensors = {name: _tensor(columns[name]) for name in dict.fromkeys((*names, *of_strata))}
    finite = _all_finite(tensors, names)
    return {name: column[finite] for name, column in tensors.items()}, int((~finite).sum())


def _all_finite(columns: Mapping[str, Tensor], names: tuple[str, ...]) -> Tensor:
    """Which samples have these numbers finite. Raises RunError where none has."""
    finite = torch.stack([columns[name] for name in names]).isfinite().all(dim=0)
    if not bool(finite.any()):
        raise RunError(
            f"predictions: none of {len(finite)} samples has finite {', '.join(names)}; train longer, or look at nll"
        )
    return finite


def _arrays(table: pa.Table | Columns, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    columns = arrays(table)
    if missing := [name for name in names if name not in columns]:
        raise RunError(
            f"predictions: column {', '.join(missing)} missing, which an older version may not have written; "
            "run the model again"
        )
    return columns


def _tensor(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.array(array, dtype=np.float64))


def _distribution(columns: Mapping[str, Tensor]) -> ProjectedHuber:
    try:
        return from_columns(columns)
    except ValueError as error:
        raise RunError(f"predictions: parameters are of no distribution ({error})") from None


def _positions(columns: Mapping[str, Tensor]) -> Tensor:
    return torch.stack([columns[name] for name in XYZ], dim=-1)

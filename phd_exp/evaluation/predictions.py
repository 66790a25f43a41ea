"""Evaluates tables of predictions: scores, curves and strata with bootstrap intervals; recalibrates or mixes them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from phd_exp.distributions import Mixture, ProjectedHuber
from phd_exp.distributions.columns import NEES, distribution_columns, from_columns, nees_columns, parameter_names
from phd_exp.distributions.temperature import Temperature
from phd_exp.evaluation.parquet import Arrays, require_columns, stacked
from phd_exp.evaluation.point_errors import RESAMPLES, SEED
from phd_exp.evaluation.reference import calibrated_reference, groups_of
from phd_exp.evaluation.volumes import drawn_columns
from phd_exp.metrics.bootstrap import Interval, Statistic, bands, interval, means, resampled
from phd_exp.metrics.calibration_scores import COLUMNS, abscissae, calibration_scores, curves, ordered
from phd_exp.metrics.errors import MILLIMETRES
from phd_exp.metrics.groups import worst_group
from phd_exp.metrics.strata import strata as split
from phd_exp.records.errors import RunError

XYZ = ("x", "y", "z")
Rows = slice | Bool[np.ndarray, " rows"]
ERRORS = ("projected_error_mm", "depth_error_mm")
OF_DISTANCE = ("ale_m", "relative_error")
OPTIONAL = (*OF_DISTANCE, "log_volume")  # younger than the first records, or measured with held-out samples
OF_A_DISTRIBUTION = (*XYZ, *COLUMNS, *ERRORS, "nll", "energy_score")
STRATIFIED_BY: Mapping[str, tuple[str, str, tuple[float, ...] | int]] = {
    "visibility": ("visibility", "", (0.0, 0.25, 0.5, 0.75, 0.95, 1.0)),
    "truncation": ("truncation", "", (0.0, 0.05, 0.25, 0.5, 1.0)),
    "depth": ("z", "m", 4),
    "focal length": ("f", "px", 4),
}
"""Quantity of the strata -> its column, its unit, and edges or a number of equal parts.

Predictions in strata of true depth are not calibrated even if all predictions are: true depth is the predicted
quantity.
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
    scores: dict[str, Interval[float]]


@dataclass(frozen=True)
class Evaluation:
    """The evaluation of n samples; `left_out` further samples had values that are not finite.

    Attributes:
        scores: means of `ERRORS` and, if present, of `OPTIONAL`; of a distribution also of `nll` (nats) and
            `energy_score_mm`, the per cent `inside_90` of truths in regions of 90 %, and the `calibration_scores`; of
            Projected Huber densities the means of `nees_columns`, and `group_miscalibration`.
        reference: of each score of `REFERENCED`, the median and 95 % interval for calibrated predictions with equal
            uncertainties (`calibrated_reference`): a distance from calibration is never zero.
        curves: `metrics.calibration_scores.curves`; x is the predicted variance, credible level, PIT, or share kept.
        resampled: each score on resampled test images, the same images for all runs with equal n.
    """

    n: int
    scores: dict[str, Interval[float]]
    left_out: int
    curves: dict[str, Curve] = field(default_factory=dict)
    strata: list[Stratum] = field(default_factory=list)
    reference: dict[str, Interval[float]] = field(default_factory=dict)
    resampled: dict[str, list[float]] = field(default_factory=dict)


def evaluate(table: Arrays, resamples: int = RESAMPLES, stratified: bool = True) -> Evaluation:
    """Evaluate predictions: of a density if the table has its levels, else of points, which have no curves.

    Raises RunError if a column is missing, or if fewer than two samples have finite values.
    """
    is_distribution, is_huber = "level" in table, "a" in table
    needed = (*(parameter_names(table) if is_huber else ()), *OF_A_DISTRIBUTION) if is_distribution else ERRORS
    needed += tuple(name for name in OPTIONAL if name in table)
    columns, finite = finite_columns(table, needed, [name for name, _, _ in STRATIFIED_BY.values() if name in table])
    statistic: Statistic = _distribution_scores if is_distribution else _point_scores
    whole, found, reference = statistic, {}, {}
    if int(finite.sum()) == 1:
        raise RunError("predictions: one test sample; expected at least two, for intervals")
    if is_huber:
        distribution = _distribution(columns)
        columns |= nees_columns(distribution, stacked(columns, XYZ))
        whole = partial(_distribution_scores, groups=groups_of(distribution))
        reference = calibrated_reference(distribution)
    if is_distribution:
        x = abscissae(columns)
        y = {name: band.each(Tensor.tolist) for name, band in bands(curves, columns, resamples, SEED).items()}
        found = {name: Curve(x[name].tolist(), band.value, band.low, band.high) for name, band in y.items()}
    scored = evaluation_of(whole, columns, int((~finite).sum()), resamples)
    strata = _strata(statistic, columns, resamples) if stratified else []
    return replace(scored, curves=found, strata=strata, reference=reference)


def evaluation_of(statistic: Statistic, columns: Mapping[str, Tensor], left_out: int, resamples: int) -> Evaluation:
    """The scores that a statistic finds in columns of samples, with their bootstrap."""
    values, drawn = resampled(statistic, columns, resamples, SEED)
    return Evaluation(
        n=len(next(iter(columns.values()))),
        scores={name: interval(value, drawn[name]).each(float) for name, value in values.items()},
        left_out=left_out,
        resampled={name: value.tolist() for name, value in drawn.items()},
    )


def fit_temperature(held_out: Arrays, rows: Rows = slice(None)) -> Temperature:
    """The temperatures fitted on predictions of held-out samples: of all rows, or of those that choose.

    Raises RunError if a column is missing, or if no temperature fits.
    """
    distribution, xyz, _ = at_temperature(held_out, None, rows)
    try:
        return Temperature.fit(distribution, xyz)
    except ValueError as error:
        raise RunError(f"predictions: no temperature fits them ({error})") from None


def recalibrated(table: Arrays, temperature: Temperature) -> dict[str, np.ndarray]:
    """The same columns for A / projected and a / depth: modes are unchanged, all uncertainties and scores change.

    Drops samples whose parameters are not finite. Raises RunError if a column is missing, or if no sample is left.

    Examples:
        >>> from phd_exp.distributions import ProjectedHuber
        >>> one = ProjectedHuber(torch.zeros(1, 2), torch.full((1,), 4.0), torch.eye(2)[None], torch.ones(1))
        >>> table = {name: column.numpy() for name, column in distribution_columns(one, torch.ones(1, 3)).items()}
        >>> xyz = {name: np.ones(1) for name in "xyz"}
        >>> recalibrated(table | xyz, Temperature(projected=2.0, depth=4.0))["a"].tolist()
        [0.25]
    """
    distribution, xyz, kept = at_temperature(table, temperature)
    changed = distribution_columns(distribution, xyz)
    changed |= drawn_columns(distribution, xyz, SEED)
    return kept | {name: column.numpy() for name, column in changed.items()}


def ensemble_table(tables: Sequence[Arrays]) -> Arrays:
    """The scores and parameters of the ensemble's closest distributions, and the members' `disagreement` (nats).

    Raises RunError if a column is missing, or the tables are of different samples.
    """
    parameters = parameter_names({name for table in tables for name in table})
    for table in tables:
        require_columns((*parameters, *XYZ), table)
        names = [name for name in (*XYZ, "file_name") if name in table]
        if not all(name in tables[0] and np.array_equal(table[name], tables[0][name]) for name in names):
            raise RunError("predictions: those of an ensemble are of different samples; train on one data set")
    columns = {name: torch.tensor(np.stack([table[name] for table in tables], axis=-1)) for name in parameters}
    mixture = Mixture(_distribution(columns))
    scores = distribution_columns(mixture.closest, stacked(tables[0], XYZ)) | {"disagreement": mixture.disagreement}
    kept = {name: tables[0][name] for name in (*XYZ, "f", "S", "block") if name in tables[0]}
    return kept | {name: column.numpy() for name, column in scores.items()}


def at_temperature(
    table: Arrays, temperature: Temperature | None, rows: Rows = slice(None)
) -> tuple[ProjectedHuber, Float[Tensor, "samples 3"], dict[str, np.ndarray]]:
    """Predictions (None: as trained), true positions (m) and all columns of the rows with finite parameters.

    Raises RunError if a column is missing, or if no row is finite.
    """
    recorded = {name: array[rows] for name, array in table.items()}
    columns, finite = finite_columns(recorded, (*parameter_names(recorded), *XYZ))
    distribution = _distribution(columns)
    kept = {name: array[finite.numpy()] for name, array in recorded.items()}
    return temperature.apply(distribution) if temperature else distribution, stacked(columns, XYZ), kept


def _distribution_scores(
    columns: Mapping[str, Tensor], weight: Tensor, groups: Tensor | None = None
) -> dict[str, Tensor]:
    recorded = {"nll": columns["nll"], "inside_90": inside(columns["level"], 0.9)}
    recorded["energy_score_mm"] = MILLIMETRES * columns["energy_score"]
    scores = _point_scores(columns, weight) | means(recorded, weight) | calibration_scores(ordered(columns, weight))
    scores |= means({name: columns[name] for name in NEES if name in columns}, weight)
    if groups is not None:
        scores["group_miscalibration"] = worst_group(columns["level"], groups, weight)
    return scores


def inside(level: Float[Tensor, " samples"], probability: float) -> Float[Tensor, " samples"]:
    """Per cent: 100 for a truth inside the credible region of this probability, given the truth's level; else 0."""
    return 100.0 * (level <= probability).double()


def _point_scores(columns: Mapping[str, Tensor], weight: Tensor) -> dict[str, Tensor]:
    return means({name: columns[name] for name in (*ERRORS, *OPTIONAL) if name in columns}, weight)


def scalar_bands(
    statistic: Statistic, columns: Mapping[str, Tensor], resamples: int = RESAMPLES
) -> dict[str, Interval[float]]:
    """The 95 % bootstrap intervals of scalars, as plain numbers."""
    return {name: found.each(float) for name, found in bands(statistic, columns, resamples, SEED).items()}


def _strata(statistic: Statistic, columns: Mapping[str, Tensor], resamples: int) -> list[Stratum]:
    found = []
    for quantity, (column, unit, edges) in STRATIFIED_BY.items():
        for label, mask in split(quantity, columns[column], edges, unit).items() if column in columns else ():
            part, n = {name: values[mask] for name, values in columns.items()}, int(mask.sum())
            found += [Stratum(quantity, label, n, scalar_bands(statistic, part, resamples))] if n > 1 else []
    return found


def finite_columns(
    table: Arrays, names: Sequence[str], others: Sequence[str] = ()
) -> tuple[dict[str, Tensor], Bool[Tensor, " samples"]]:
    """The columns `names` and `others` of the samples whose `names` are finite, and which samples these are.

    Raises RunError if one of `names` is missing, or if no sample is finite.
    """
    require_columns(names, table)
    columns = {name: torch.from_numpy(np.array(table[name], dtype=np.float64)) for name in (*names, *others)}
    finite = torch.stack([columns[name] for name in names]).isfinite().all(dim=0)
    if len(finite) and not bool(finite.any()):
        raise RunError(
            f"predictions: none of {len(finite)} samples has finite {', '.join(names)}; train longer, or look at nll"
        )
    return {name: column[finite] for name, column in columns.items()}, finite


def _distribution(columns: Mapping[str, Tensor]) -> ProjectedHuber:
    try:
        return from_columns(columns)
    except ValueError as error:
        raise RunError(f"predictions: parameters are of no distribution ({error})") from None

"""Mean errors of a run's point estimates, from its `predictions.parquet` alone.

The columns used, a row a test sample; positions are metres in the camera frame:

    x, y, z                  the truth
    f, S                     focal length and side of the image, both in pixels of one image
    mode_x, mode_y, mode_z   the estimate of every model
    mean_x, mean_y, mean_z   of a distribution: its mean
    median_z, mu_x, mu_y     of a distribution: the median of depth, and the projected centre
    nll                      of a distribution: -log p(truth), nats; not needed
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Float64

from phd_exp.evaluation.parquet import read_table
from phd_exp.records.errors import RunError

Estimate = Literal["mode", "mean", "median"]
Reading = Literal["whole", "central"]
Quantity = Literal["projected", "depth"]

READINGS: tuple[Reading, ...] = ("whole", "central")
QUANTITIES: tuple[Quantity, ...] = ("projected", "depth")
COLUMNS: Mapping[Estimate, tuple[str, str, str]] = {
    "mode": ("mode_x", "mode_y", "mode_z"),
    "mean": ("mean_x", "mean_y", "mean_z"),
    "median": ("mu_x", "mu_y", "median_z"),
}
CENTRAL = 0.5
"""Largest |v_p| of either coordinate in the central half of the field of view."""

Points = Float64[np.ndarray, "n 3"]
PerSample = Float64[np.ndarray, " n"]


@dataclass(frozen=True)
class ErrorKey:
    """Which error: of which point estimate, over which test samples, along the true ray or across it."""

    estimate: Estimate
    reading: Reading
    quantity: Quantity


@dataclass(frozen=True)
class SampleMean:
    """A mean over n test samples, and its standard error (none of a single sample)."""

    n: int
    value: float
    standard_error: float | None

    @classmethod
    def of(cls, values: PerSample) -> "SampleMean":
        """The mean of these values, one a sample."""
        n = len(values)
        return cls(n, float(values.mean()), float(values.std(ddof=1) / np.sqrt(n)) if n > 1 else None)


MeanErrors = Mapping[ErrorKey, SampleMean]
"""Millimetres; a reading without a test sample has no key."""


def mean_errors(file: Path, estimates: Sequence[Estimate]) -> MeanErrors:
    """The mean errors of the asked estimates, in both readings.

    Raises RunError, one line, where the file cannot be read, lacks a column or a row, or holds what is no number.
    """
    names = ["x", "y", "z", "f", "S", *(name for estimate in estimates for name in COLUMNS[estimate])]
    table = _read(file, names)
    truth = np.stack([table["x"], table["y"], table["z"]], axis=-1)
    central = in_central_half(truth, table["f"], table["S"])
    with np.errstate(over="ignore", invalid="ignore"):  # told below, with the file's name
        means = dict(_means(truth, central, {name: _points(table, name) for name in estimates}))
    if not all(np.isfinite(mean.value) for mean in means.values()):
        raise RunError(f"{file.name}: holds estimates so far off that their mean error is no finite number")
    return means


def mean_nll(file: Path) -> float | None:
    """The mean of the column `nll`, nats; None where a point estimate left none, or it cannot be read."""
    try:
        return float(_read(file, ["nll"])["nll"].mean())
    except RunError:
        return None


def in_central_half(truth: Points, f: PerSample, S: PerSample) -> Bool[np.ndarray, " n"]:
    """Whether a position lies in the central half of the field of view, |v_p| <= 1/2 in both coordinates.

    v_p = 2 f (x, y) / (S z), where the authors' generator places its objects.
    """
    projected = 2 * f[:, None] * truth[:, :2] / (S * truth[:, 2])[:, None]
    return (np.abs(projected) <= CENTRAL).all(axis=-1)


def errors_mm(truth: Points, estimate: Points) -> dict[Quantity, PerSample]:
    """The two columns of the paper's tables, millimetres a sample.

    With v_par = (v . v^ / |v|^2) v: projected = |v^ - v_par|, depth = | |v_par| - |v| |.

    Source: the paper's section on experiments; `phd_exp.metrics.errors` has it for a network's tensors.
    """
    along = (truth * estimate).sum(axis=-1, keepdims=True) / np.square(truth).sum(axis=-1, keepdims=True)
    on_ray = along * truth
    depth = np.abs(np.linalg.norm(on_ray, axis=-1) - np.linalg.norm(truth, axis=-1))
    return {"projected": 1000 * np.linalg.norm(estimate - on_ray, axis=-1), "depth": 1000 * depth}


def _means(
    truth: Points, central: Bool[np.ndarray, " n"], estimates: Mapping[Estimate, Points]
) -> Iterator[tuple[ErrorKey, SampleMean]]:
    for estimate, points in estimates.items():
        for quantity, values in errors_mm(truth, points).items():
            yield ErrorKey(estimate, "whole", quantity), SampleMean.of(values)
            if central.any():
                yield ErrorKey(estimate, "central", quantity), SampleMean.of(values[central])


def _points(table: Mapping[str, PerSample], estimate: Estimate) -> Points:
    """The estimate's coordinates; the median is median_z (mu_x, mu_y, 1), on the ray of the projected centre."""
    x, y, z = (table[name] for name in COLUMNS[estimate])
    return np.stack([z * x, z * y, z] if estimate == "median" else [x, y, z], axis=-1)


def _read(file: Path, names: Sequence[str]) -> dict[str, PerSample]:
    content = read_table(file, names)
    table = {name: content.column(name).cast(pa.float64()).to_numpy() for name in names}
    _require_numbers(file, table)
    return table


def _require_numbers(file: Path, table: Mapping[str, PerSample]) -> None:
    for name, values in table.items():
        if not len(values):
            raise RunError(f"{file.name}: has no rows")
        if not np.isfinite(values).all():
            row = int(np.flatnonzero(~np.isfinite(values))[0])
            raise RunError(
                f"{file.name}: column {name} is {values[row]} in row {row}; expected a finite number"
            )
        if name in ("z", "f", "S") and values.min() <= 0:
            row = int(values.argmin())
            raise RunError(
                f"{file.name}: column {name} is {values[row]:g} in row {row}; expected more than 0"
            )

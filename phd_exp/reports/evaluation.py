"""Stand-in for the evaluation that another branch brings: the same names, coarse intervals. Replaced at the merge."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa

Table = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Band:
    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Curve:
    x: list[float]
    y: list[float]
    low: list[float]
    high: list[float]


@dataclass(frozen=True)
class Stratum:
    quantity: str
    label: str
    n: int
    scores: dict[str, Band]


@dataclass(frozen=True)
class Evaluation:
    n: int
    scores: dict[str, Band]
    curves: dict[str, Curve] = field(default_factory=dict)
    strata: list[Stratum] = field(default_factory=list)


@dataclass(frozen=True)
class Temperature:
    projected: float
    depth: float


def _table(table: pa.Table | Table) -> dict[str, np.ndarray]:
    if isinstance(table, pa.Table):
        return {name: table[name].to_numpy() for name in table.column_names}
    return dict(table)


def _band(values: np.ndarray) -> Band:
    half = 1.96 * values.std() / np.sqrt(max(len(values), 1))
    return Band(float(values.mean()), float(values.mean() - half), float(values.mean() + half))


def _strata(columns: dict[str, np.ndarray], names: tuple[str, ...]) -> list[Stratum]:
    found = []
    for quantity, column in (
        ("visibility", "visibility"),
        ("truncation", "truncation"),
        ("depth", "z"),
        ("focal length", "f"),
    ):
        if column not in columns:
            continue
        edges = np.unique(np.quantile(columns[column], [0, 0.25, 0.5, 0.75, 1]))
        for low, high in zip(edges[:-1], edges[1:], strict=True):
            inside = (columns[column] >= low) & (columns[column] <= high)
            scores = {name: _band(columns[name][inside]) for name in names}
            found.append(Stratum(quantity, f"{low:.2g}–{high:.2g}", int(inside.sum()), scores))
    return found


def _curve(x: np.ndarray, y: np.ndarray, spread: float = 0.1) -> Curve:
    return Curve(x.tolist(), y.tolist(), (y * (1 - spread)).tolist(), (y * (1 + spread)).tolist())


def _smooth(table: dict[str, np.ndarray], name: str, window: int) -> Curve:
    order = np.argsort(table[f"{name}_variance"])
    kernel = np.ones(window) / window
    x, y = (
        np.convolve(table[f"{name}_{part}"][order], kernel, "valid") for part in ("variance", "squared_error")
    )
    return _curve(x, y, 0.2)


def _risk(uncertainty: np.ndarray, error: np.ndarray) -> Curve:
    ordered = error[np.argsort(uncertainty)]
    n = np.arange(1, len(error) + 1)
    return _curve(n / len(error), np.cumsum(ordered) / n)


def evaluate_points(table: pa.Table | Table) -> Evaluation:
    columns = _table(table)
    names = ("projected_error_mm", "depth_error_mm")
    return Evaluation(len(columns["x"]), {n: _band(columns[n]) for n in names}, {}, _strata(columns, names))


def evaluate(table: pa.Table | Table, window: int = 200, resamples: int = 200) -> Evaluation:
    columns = _table(table)
    n = len(columns["x"])
    window = max(1, min(window, n // 5))
    names = ("projected_error_mm", "depth_error_mm", "nll")
    grid = np.linspace(0, 1, 51)
    coverage = np.array([(columns["level"] <= p).mean() for p in grid])
    curves = {
        "depth_calibration": _smooth(columns, "depth", window),
        "projected_calibration": _smooth(columns, "projected", window),
        "coverage": _curve(grid, coverage),
        "depth_pit": _curve(grid, coverage),
        "depth_risk_coverage": _risk(columns["depth_variance"], columns["depth_error_mm"]),
        "projected_risk_coverage": _risk(columns["projected_variance"], columns["projected_error_mm"]),
    }
    scores = {name: _band(columns[name]) for name in names}
    scores["miscalibration_area"] = _band(np.abs(coverage - grid))
    return Evaluation(n, scores, curves, _strata(columns, names))


def fit_temperature(held_out: pa.Table | Table) -> Temperature:
    return Temperature(1.0, 1.0)


def recalibrated(table: pa.Table | Table, temperature: Temperature) -> pa.Table | Table:
    return table

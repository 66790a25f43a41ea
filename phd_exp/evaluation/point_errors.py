"""Mean errors of a run's point estimates, from its table of predictions.

Columns, one row per sample; positions are metres in the camera frame:

    x, y, z                  the truth
    f, S                     focal length and side of the image, both in pixels of the same image
    mode_x, mode_y, mode_z   the estimate of every model
    mean_x, mean_y, mean_z   a distribution's mean
    median_z, mu_x, mu_y     a distribution's median of depth, and its projected centre
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np
from jaxtyping import Bool, Float64
from scipy import special
from torch import Tensor

from phd_exp.evaluation.parquet import Arrays, require_columns, stacked
from phd_exp.metrics.bootstrap import Interval
from phd_exp.metrics.errors import MILLIMETRES, depth_error, projected_error
from phd_exp.records.errors import RunError

Estimate = Literal["mode", "mean", "median", "eight views"]
Reading = Literal["whole", "central"]
Quantity = Literal["projected", "depth"]
Key = TypeVar("Key")

READINGS: tuple[Reading, ...] = ("whole", "central")
COLUMNS: Mapping[Estimate, tuple[str, str, str]] = {
    "mode": ("mode_x", "mode_y", "mode_z"),
    "mean": ("mean_x", "mean_y", "mean_z"),
    "median": ("mu_x", "mu_y", "median_z"),
}
CENTRAL = 0.5  # largest |v_p| of both coordinates in the central half of the field of view
RESAMPLES = 200
SEED = 0  # seed of all bootstraps: runs tested on the same images are resampled alike, so that differences are paired
_ERRORS: Mapping[Quantity, Callable[[Tensor, Tensor], Tensor]] = {"projected": projected_error, "depth": depth_error}


@dataclass(frozen=True)
class ErrorKey:
    """An error: its point estimate, its test samples, and whether it is along the true ray or across it.

    The estimate of eight views is the mode of the ensemble of an image's eight symmetric views.
    """

    estimate: Estimate
    reading: Reading
    quantity: Quantity


@dataclass(frozen=True)
class SampleMean:
    """A mean over n test samples; its standard error is None for a single sample."""

    n: int
    value: float
    standard_error: float | None


MeanErrors = Mapping[ErrorKey, SampleMean]
"""Mean errors in millimetres; a reading without a test sample has no key."""


def mean_errors(table: Arrays, estimates: Sequence[Estimate]) -> MeanErrors:
    """The mean errors of these estimates, in both readings.

    Raises RunError, one line, if the table lacks a column or a mean is not finite.

    Examples:
        >>> row = {"x": 0, "y": 0, "z": 4, "f": 1500, "S": 224, "mode_x": 0.003, "mode_y": 0.004, "mode_z": 4.5}
        >>> found = mean_errors({name: np.array([value], dtype=float) for name, value in row.items()}, ["mode"])
        >>> found[ErrorKey("mode", "whole", "projected")].value, found[ErrorKey("mode", "whole", "depth")].value
        (5.0, 500.0)
    """
    needed = ["x", "y", "z", "f", "S", *(name for estimate in estimates for name in COLUMNS[estimate])]
    require_columns(needed, table)
    for name in needed:
        if not (np.isfinite(table[name]).all() and (name not in ("z", "f", "S") or (table[name] > 0).all())):
            raise RunError(f"predictions: column {name} is not finite everywhere, or not positive")
    truth = stacked(table, ("x", "y", "z"))
    central = in_central_half(truth, stacked(table, ("f",)), stacked(table, ("S",)))
    found: dict[ErrorKey, SampleMean] = {}
    for estimate in estimates:
        points = stacked(table, COLUMNS[estimate])
        if estimate == "median":  # median_z (mu_x, mu_y, 1), on the ray of the projected centre
            points[:, :2] *= points[:, 2:]
        for quantity, error in _ERRORS.items():
            values = MILLIMETRES * error(truth, points)
            found[ErrorKey(estimate, "whole", quantity)] = _mean(values)
            if bool(central.any()):
                found[ErrorKey(estimate, "central", quantity)] = _mean(values[central])
    if not all(np.isfinite(mean.value) for mean in found.values()):
        raise RunError("predictions: are so far off that a mean error is not finite")
    return found


def in_central_half(
    truth: Float64[Tensor, "n 3"], f: Float64[Tensor, "n 1"], S: Float64[Tensor, "n 1"]
) -> Bool[Tensor, " n"]:
    """Whether a position lies in the central half of the field of view, |v_p| <= 1/2 in both coordinates.

    v_p = 2 f (x, y) / (S z). The authors' generator places all objects there.
    """
    return ((2 * f * truth[:, :2] / (S * truth[:, 2:])).abs() <= CENTRAL).all(dim=-1)


def _mean(values: Tensor) -> SampleMean:
    n = len(values)
    return SampleMean(n, float(values.mean()), float(values.std() / n**0.5) if n > 1 else None)


def paired(one: Mapping[int, float], other: Mapping[int, float]) -> tuple[Interval[float], float]:
    """The mean over the seeds of both of `one` minus `other`, its 95 % interval, and the p-value of no difference.

    A paired t-test over n seeds with n - 1 degrees of freedom, two-sided: whether other trainings would differ on
    these test images. With fewer than two seeds in common the interval is infinite.

    Examples:
        >>> gap, p = paired({0: 1.0, 1: 2.0, 2: 4.0}, {0: 2.0, 1: 3.5, 2: 6.0})
        >>> round(gap.value, 2), round(gap.high, 2), round(p, 3)
        (-1.5, -0.26, 0.035)
    """
    gaps = np.array([one[seed] - other[seed] for seed in sorted(one.keys() & other.keys())])
    k, gap = len(gaps), float(np.mean(list(one.values())) - np.mean(list(other.values())))
    if k < 2:
        return Interval(gap, -np.inf, np.inf), 1.0
    gap, error = float(gaps.mean()), float(gaps.std(ddof=1)) / k**0.5
    half_width = float(special.stdtrit(k - 1, 0.975)) * error
    p_value = float(2 * special.stdtr(k - 1, -abs(gap) / error)) if error > 0 else float(gap == 0)
    return Interval(gap, gap - half_width, gap + half_width), p_value


def significant(p_values: Mapping[Key, float], error_rate: float = 0.05) -> set[Key]:
    """The keys whose hypotheses are rejected, with a probability of `error_rate` at most that one of them is true.

    Raises ValueError for a p-value that is not in [0, 1], such as NaN.
    Source: Holm, "A simple sequentially rejective multiple test procedure" (1979).

    Examples:
        >>> sorted(significant({"a": 0.01, "b": 0.03, "c": 0.04}))
        ['a']
    """
    if bad := [value for value in p_values.values() if not 0 <= value <= 1]:
        raise ValueError(f"p_values: got {bad[0]}; expected probabilities in [0, 1]")
    found: set[Key] = set()
    for place, key in enumerate(sorted(p_values, key=p_values.__getitem__)):
        if p_values[key] * (len(p_values) - place) > error_rate:
            break
        found.add(key)
    return found

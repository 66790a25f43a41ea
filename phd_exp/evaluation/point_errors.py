"""Mean errors of a run's point estimates, from its table of predictions.

The columns used, a row a test sample; positions are metres in the camera frame:

    x, y, z                  the truth
    f, S                     focal length and side of the image, both in pixels of one image
    mode_x, mode_y, mode_z   the estimate of every model
    mean_x, mean_y, mean_z   of a distribution: its mean
    median_z, mu_x, mu_y     of a distribution: the median of depth, and the projected centre
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float64
from scipy import stats
from torch import Tensor

from phd_exp.evaluation.parquet import Columns
from phd_exp.metrics.bootstrap import means, resampled
from phd_exp.metrics.errors import MILLIMETRES, depth_error, projected_error
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
RESAMPLES = 200
SEED = 0
"""Of all bootstraps: runs that were tested on the same images are resampled alike, and can be compared in pairs."""
_ERRORS = {"projected": projected_error, "depth": depth_error}


@dataclass(frozen=True)
class ErrorKey:
    """Which error: of which point estimate, over which test samples, along the true ray or across it."""

    estimate: Estimate
    reading: Reading
    quantity: Quantity


@dataclass(frozen=True)
class SampleMean:
    """A mean over n test samples.

    Attributes:
        standard_error: None for a single sample.
        resampled: the mean over resampled test images; the same images for all runs with as many of them.
    """

    n: int
    value: float
    standard_error: float | None
    resampled: np.ndarray = field(default_factory=lambda: np.empty(0), repr=False, compare=False)


MeanErrors = Mapping[ErrorKey, SampleMean]
"""Millimetres; a reading without a test sample has no key."""


def mean_errors(table: Columns, estimates: Sequence[Estimate]) -> MeanErrors:
    """The mean errors of these estimates, in both readings.

    Raises RunError, one line, where the table lacks a column or a mean is not finite.
    """
    needed = ["x", "y", "z", "f", "S", *(name for estimate in estimates for name in COLUMNS[estimate])]
    if lacking := [name for name in needed if name not in table]:
        raise RunError(f"predictions: have no column {', '.join(lacking)}; run the model again")
    for name in needed:
        if not (np.isfinite(table[name]).all() and (name not in ("z", "f", "S") or (table[name] > 0).all())):
            raise RunError(f"predictions: column {name} is not finite everywhere, or not positive")
    truth = _stacked(table, ("x", "y", "z"))
    central = in_central_half(truth, _stacked(table, ("f",)), _stacked(table, ("S",)))
    found = dict(_means(truth, central, {name: _points(table, name) for name in estimates}))
    if not all(np.isfinite(mean.value) for mean in found.values()):
        raise RunError("predictions: are so far off that a mean error is not finite")
    return found


def in_central_half(
    truth: Float64[Tensor, "n 3"], f: Float64[Tensor, "n 1"], S: Float64[Tensor, "n 1"]
) -> Bool[Tensor, " n"]:
    """Whether a position lies in the central half of the field of view, |v_p| <= 1/2 in both coordinates.

    v_p = 2 f (x, y) / (S z). The authors' generator places its objects there.
    """
    return ((2 * f * truth[:, :2] / (S * truth[:, 2:])).abs() <= CENTRAL).all(dim=-1)


def _means(
    truth: Tensor, central: Tensor, estimates: Mapping[Estimate, Tensor]
) -> Iterator[tuple[ErrorKey, SampleMean]]:
    for reading, chosen in (("whole", torch.ones_like(central)), ("central", central)):
        if not bool(chosen.any()):
            continue
        columns = {
            f"{estimate} {quantity}": MILLIMETRES * error(truth, points)[chosen]
            for estimate, points in estimates.items()
            for quantity, error in _ERRORS.items()
        }
        _, drawn = resampled(means, columns, RESAMPLES, SEED)
        for name, values in columns.items():
            estimate, quantity = name.split()
            n = len(values)
            error = float(values.std() / n**0.5) if n > 1 else None
            mean = SampleMean(n, float(values.mean()), error, drawn[name].numpy())
            yield ErrorKey(estimate, reading, quantity), mean  # type: ignore[arg-type]


def _stacked(table: Columns, names: Sequence[str]) -> Tensor:
    return torch.from_numpy(np.stack([table[name] for name in names], axis=-1))


def _points(table: Columns, estimate: Estimate) -> Tensor:
    """The estimate's coordinates; the median is median_z (mu_x, mu_y, 1), on the ray of the projected centre."""
    points = _stacked(table, COLUMNS[estimate])
    if estimate == "median":
        points[:, :2] *= points[:, 2:]
    return points


def difference(one: Sequence[SampleMean], other: Sequence[SampleMean]) -> tuple[float, float]:
    """Mean of `one` minus mean of `other`, each a mean a seed, and the half width of its 95 % interval.

    The standard error is that of a bootstrap over seeds of each model and over the test images that they share;
    deviations of seeds are scaled by sqrt(k / (k - 1)), since k seeds are few, and the interval uses Student's law
    with the seeds' degrees of freedom. One seed says nothing of another training: the half width is then infinite.

    Source: Davison and Hinkley, "Bootstrap methods and their application" (1997), section 2.3 (small samples).
    """
    gap = float(np.mean([mean.value for mean in one]) - np.mean([mean.value for mean in other]))
    if min(len(one), len(other)) < 2:
        return gap, float("inf")
    random = np.random.default_rng(SEED)
    drawn = _over_seeds(one, random) - _over_seeds(other, random)
    freedom = len(one) + len(other) - 2
    return gap, float(stats.t.ppf(0.975, freedom) * drawn.std(ddof=1))


def _over_seeds(means: Sequence[SampleMean], random: np.random.Generator) -> np.ndarray:
    """Resampled means: seeds and images are drawn anew each time."""
    values, k = np.stack([mean.resampled for mean in means]), len(means)
    weights = random.multinomial(k, [1 / k] * k, values.shape[1]).T / k
    return np.asarray((values * (1 / k + np.sqrt(k / (k - 1)) * (weights - 1 / k))).sum(0))

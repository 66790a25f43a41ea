"""One number of a table: the errors of a model's runs, averaged over seeds, with an interval."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy import stats

from phd_exp.evaluation.point_errors import ErrorKey, SampleMean, difference
from phd_exp.reports.paper import bound_mm, published_mm
from phd_exp.reports.runs import Report, Run, RunState

IntervalKind = Literal["student_t_over_seeds", "normal_over_samples", "none"]
GapState = RunState | Literal["missing", "no sample"]
COVERAGE = 0.95


@dataclass(frozen=True)
class Interval:
    """A mean and its 95 % interval, mean ± half_width; None if there is no interval."""

    mean: float
    half_width: float | None
    kind: IntervalKind

    @property
    def ends(self) -> tuple[float, float] | tuple[None, None]:
        """Lower and upper end."""
        if self.half_width is None:
            return None, None
        return self.mean - self.half_width, self.mean + self.half_width


@dataclass(frozen=True)
class Gap:
    """A run that is missing in a table, with the reason."""

    data: str
    model: str
    seed: int
    state: GapState
    detail: str = ""


@dataclass(frozen=True)
class Cell:
    """One number of a table, millimetres, and its sources.

    Attributes:
        means: seed -> mean error, of the finished runs.
        images: digests of the test images; a single one if all runs were tested on the same images.
        sees_f: whether the focal length is an input of the networks.
        gaps: seeds that are missing here and that other cells of the table have or that were started.
    """

    preset: str
    data: str
    model: str
    key: ErrorKey
    means: dict[int, SampleMean]
    images: frozenset[str]
    sees_f: bool
    gaps: tuple[Gap, ...]

    @property
    def interval(self) -> Interval | None:
        """The mean over seeds and its interval; None if no run has finished."""
        return interval(list(self.means.values())) if self.means else None

    @property
    def mean(self) -> float | None:
        """Our mean, mm; None if no run has finished."""
        return self.interval.mean if self.interval else None

    @property
    def state(self) -> str:
        """`finished`, the reason for a missing number, or the number of finished seeds."""
        if not self.gaps:
            return "finished"
        if not self.means:
            return self.gaps[0].state
        return f"{len(self.means)} of {len(self.means) + len(self.gaps)} seeds"

    @property
    def published(self) -> float | None:
        """The paper's figure, mm."""
        return published_mm(self.model, self.data, self.key.estimate, self.key.quantity)

    @property
    def bound(self) -> float | None:
        """The bound on the mean, mm, that applies to these runs."""
        return bound_mm(self.model, self.data, self.key.quantity, self.sees_f)

    @property
    def ratio(self) -> float | None:
        """Ours over the paper's."""
        return self.mean / self.published if self.mean is not None and self.published else None

    def beats(self, other: "Cell") -> bool:
        """Whether this mean is significantly smaller: a paired bootstrap over seeds and the shared test images."""
        if len(self.images | other.images) != 1:
            return False
        gap, half_width = difference(list(self.means.values()), list(other.means.values()))
        return gap < -half_width

    def numbers(self, table: str, bold: bool) -> dict[str, Any]:
        """A line of CSV."""
        low, high = self.interval.ends if self.interval else (None, None)
        return {
            "preset": self.preset, "table": table, "data": self.data, "model": self.model,
            "estimate": self.key.estimate, "reading": self.key.reading,
            "quantity": f"{self.key.quantity}_error_mm", "n_seeds": len(self.means),
            "mean": self.mean, "low": low, "high": high, "interval": self.interval.kind if self.interval else "none",
            "published": self.published, "ratio": self.ratio, "bound": self.bound, "best": bold,
            # the smallest, if runs were tested on different numbers of samples
            "n_test": min((mean.n for mean in self.means.values()), default=0), "state": self.state,
        }  # fmt: skip


def make_cell(report: Report, preset: str, data: str, model: str, key: ErrorKey, seeds: Sequence[int]) -> Cell:
    """The cell of a preset, data set, model and error, for these seeds."""
    runs = report.at_defaults(preset, data, model)
    gaps = [
        _gap(runs.get(seed), data, model, seed) for seed in seeds if seed not in runs or key not in runs[seed].errors
    ]
    measured = {seed: run for seed, run in sorted(runs.items()) if key in run.errors}
    return Cell(
        preset=preset,
        data=data,
        model=model,
        key=key,
        means={seed: run.errors[key] for seed, run in measured.items()},
        images=frozenset(run.measured.images for run in measured.values()),
        sees_f=any(run.config.get("camera.focal_length") == "shown" for run in measured.values()),
        gaps=tuple(gaps),
    )


def interval(means: Sequence[SampleMean]) -> Interval:
    """The mean over seeds with its 95 % interval.

    k >= 2 seeds with standard deviation s: mean ± t s / sqrt(k), t the 97.5 % quantile of Student's law with k - 1
    degrees of freedom, the scatter of trainings. One seed: mean ± 1.96 standard errors over its test samples, the
    scatter of test sets. One sample: no interval.

    Examples:
        >>> interval([SampleMean(100, 40.0, 1.0), SampleMean(100, 42.0, 1.0)]).mean
        41.0
    """
    values = np.array([mean.value for mean in means])
    tail = (1 + COVERAGE) / 2
    k = len(values)
    if k > 1:
        half_width = stats.t.ppf(tail, k - 1) * values.std(ddof=1) / np.sqrt(k)
        return Interval(float(values.mean()), float(half_width), "student_t_over_seeds")
    error = means[0].standard_error
    if error is None:
        return Interval(means[0].value, None, "none")
    return Interval(means[0].value, float(stats.norm.ppf(tail)) * error, "normal_over_samples")


def _gap(run: Run | None, data: str, model: str, seed: int) -> Gap:
    """Why a run has no error."""
    if run is None:
        return Gap(data, model, seed, "missing")
    if run.state != "finished":
        return Gap(data, model, seed, run.state, run.detail)
    return Gap(data, model, seed, "no sample", "none of its test samples lies in the central half")

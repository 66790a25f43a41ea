"""One number of a table: the errors of a model's runs, averaged over seeds, with an interval."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import stats

from phd_exp.evaluation.point_errors import ErrorKey, SampleMean
from phd_exp.reports.collect import Records, Run, RunState
from phd_exp.reports.paper import floor_mm, published_mm

IntervalKind = Literal["student_t_over_seeds", "normal_over_samples", "none"]
GapState = RunState | Literal["missing", "no sample"]
COVERAGE = 0.95


@dataclass(frozen=True)
class Interval:
    """A mean and its 95 % interval, mean ± half_width."""

    mean: float
    half_width: float | None
    kind: IntervalKind

    @property
    def low(self) -> float | None:
        """Lower end; None where there is no interval."""
        return None if self.half_width is None else self.mean - self.half_width

    @property
    def high(self) -> float | None:
        """Upper end; None where there is no interval."""
        return None if self.half_width is None else self.mean + self.half_width


@dataclass(frozen=True)
class Gap:
    """A run that a table wants and has not, with the reason."""

    data: str
    model: str
    seed: int
    state: GapState
    detail: str = ""


@dataclass(frozen=True)
class Cell:
    """One number of a table, millimetres, and what stands behind it.

    Attributes:
        seeds: of the finished runs that it averages.
        interval: None where no run has finished.
        n_test: test samples that count in this reading, a number a seed.
        gaps: the seeds that other cells of the table have, or at least were begun, and this one lacks.
    """

    preset: str
    data: str
    model: str
    key: ErrorKey
    seeds: tuple[int, ...]
    n_test: tuple[int, ...]
    interval: Interval | None
    gaps: tuple[Gap, ...]

    @property
    def state(self) -> str:
        """`finished`; why there is no number; or how many of the seeds there are."""
        if not self.gaps:
            return "finished"
        if self.interval is None:
            return self.gaps[0].state
        return f"{len(self.seeds)} of {len(self.seeds) + len(self.gaps)} seeds"

    @property
    def mean(self) -> float | None:
        """Ours, mm; None where no run has finished."""
        return self.interval.mean if self.interval else None

    @property
    def published(self) -> float | None:
        """The paper's figure, mm."""
        return published_mm(self.model, self.data, self.key.estimate, self.key.quantity)

    @property
    def floor(self) -> float | None:
        """What no estimator can beat, mm."""
        return floor_mm(self.model, self.data, self.key.quantity)

    @property
    def ratio(self) -> float | None:
        """Ours over the paper's."""
        return self.mean / self.published if self.mean is not None and self.published else None


def make_cell(
    records: Records, preset: str, data: str, model: str, key: ErrorKey, seeds: Sequence[int]
) -> Cell:
    """The cell of one preset, data set, model and error, which should have these seeds."""
    runs = records.at_defaults(preset, data, model)
    gaps = [gap for seed in seeds if (gap := _gap(runs.get(seed), data, model, seed, key)) is not None]
    measured = {seed: run.errors[key] for seed, run in sorted(runs.items()) if key in run.errors}
    return Cell(
        preset=preset,
        data=data,
        model=model,
        key=key,
        seeds=tuple(measured),
        n_test=tuple(mean.n for mean in measured.values()),
        interval=interval(list(measured.values())) if measured else None,
        gaps=tuple(gaps),
    )


def interval(means: Sequence[SampleMean]) -> Interval:
    """The mean over seeds with its 95 % interval.

    Of k >= 2 seeds with means m_i and their standard deviation s: mean ± t s / sqrt(k), t the 97.5 % quantile of
    Student's law with k - 1 degrees of freedom: how another training would scatter. Of one seed: mean ± 1.96
    standard errors over its test samples, how another test set would scatter; of one sample: none.
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


def seeds_of(records: Records, preset: str, choices: Iterable[tuple[str, str]]) -> list[int]:
    """Every seed with which any (data set, model) of a table was begun."""
    return sorted({seed for data, model in choices for seed in records.at_defaults(preset, data, model)})


def _gap(run: Run | None, data: str, model: str, seed: int, key: ErrorKey) -> Gap | None:
    if run is None:
        return Gap(data, model, seed, "missing")
    if run.state != "finished":
        return Gap(data, model, seed, run.state, run.detail)
    if key not in run.errors:
        return Gap(data, model, seed, "no sample", "none of its test samples lies in the central half")
    return None

"""One number of a table: the errors of a model's runs, averaged over seeds, with an interval."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy import stats

from phd_exp.evaluation.point_errors import ErrorKey, SampleMean, paired
from phd_exp.metrics.bootstrap import Interval
from phd_exp.reports.paper import PUBLISHED, bound_mm
from phd_exp.reports.runs import Report, Run
from phd_exp.reports.table import bounds


@dataclass(frozen=True)
class Cell:
    """One number of a table, millimetres, and its sources.

    Attributes:
        means: seed -> mean error, of the finished runs.
        images: digests of the test images; a single one if all runs were tested on the same images.
        interval: of the mean over seeds; None without a finished run, or with one seed and one test sample.
        published: the paper's figure, of the mode.
        bound: the bound on the mean that applies to these runs.
        gaps: seed -> why it is missing, of the seeds that other cells of the table have or that were started.
    """

    preset: str
    data: str
    model: str
    key: ErrorKey
    means: dict[int, SampleMean]
    images: frozenset[str]
    interval: Interval[float] | None
    published: float | None
    bound: float | None
    gaps: dict[int, str]

    @property
    def mean(self) -> float | None:
        """Our mean, mm; None if no run has finished."""
        return float(np.mean([mean.value for mean in self.means.values()])) if self.means else None

    @property
    def scatter(self) -> Literal["seeds_and_samples", "samples", "none"]:
        """The scatter that the interval includes."""
        if self.interval is None:
            return "none"
        return "seeds_and_samples" if len(self.means) > 1 else "samples"

    @property
    def state(self) -> str:
        """`finished`, the reason for a missing number, or the number of finished seeds."""
        if not self.gaps:
            return "finished"
        if not self.means:
            return next(iter(self.gaps.values())).partition(":")[0]
        return f"{len(self.means)} of {len(self.means) + len(self.gaps)} seeds"

    @property
    def ratio(self) -> float | None:
        """Ours over the paper's."""
        return self.mean / self.published if self.mean is not None and self.published else None

    @property
    def is_below_bound(self) -> bool:
        """Whether the mean is smaller than its bound, by chance or because more is known than the bound assumes."""
        return self.mean is not None and self.bound is not None and self.mean < self.bound

    def beats(self, other: "Cell") -> bool:
        """Whether this mean is significantly smaller: a paired t-test over seeds, on the same images."""
        ours, theirs = ({seed: mean.value for seed, mean in cell.means.items()} for cell in (self, other))
        return len(self.images | other.images) == 1 and paired(ours, theirs)[0].high < 0

    def numbers(self, table: str, bold: bool) -> dict[str, Any]:
        """A line of CSV."""
        return {
            "preset": self.preset, "table": table, "data": self.data, "model": self.model,
            "estimate": self.key.estimate, "reading": self.key.reading,
            "quantity": f"{self.key.quantity}_error_mm", "n_seeds": len(self.means),
            "mean": self.mean, **bounds(self.interval), "interval": self.scatter,
            "published": self.published, "ratio": self.ratio, "bound": self.bound, "best": bold,
            # the smallest, if runs were tested on different numbers of samples
            "n_test": min((mean.n for mean in self.means.values()), default=0), "state": self.state,
        }  # fmt: skip


def make_cell(report: Report, preset: str, data: str, model: str, key: ErrorKey, seeds: Sequence[int]) -> Cell:
    """The cell of a preset, data set, model and error, for these seeds."""
    runs = report.at_defaults(preset, data, model)
    measured = {seed: run for seed, run in sorted(runs.items()) if key in run.errors}
    means = {seed: run.errors[key] for seed, run in measured.items()}
    sees_f = any(run.config.get("camera.focal_length") == "shown" for run in measured.values())
    return Cell(
        preset=preset,
        data=data,
        model=model,
        key=key,
        means=means,
        images=frozenset(run.measured.images for run in measured.values()),
        interval=interval(list(means.values())),
        published=PUBLISHED.get((model, data), {}).get(key.quantity) if key.estimate == "mode" else None,
        bound=bound_mm(model, data, key.quantity, sees_f),
        gaps={seed: _reason(runs.get(seed), key) for seed in seeds if seed not in measured},
    )


def interval(means: Sequence[SampleMean]) -> Interval[float] | None:
    """The mean over seeds and its 95 % interval, mean ± sqrt(w_samples^2 + w_seeds^2).

    - w_samples, of another test set: 1.96 standard errors over the test samples. Seeds share these samples, so it is
      averaged over seeds; an unknown standard error counts as 0.
    - w_seeds, of another training: t s / sqrt(k), where s is the standard deviation over k seeds and t the 97.5 %
      quantile of Student's law with k - 1 degrees of freedom. It is left out for one seed, which cannot tell it.

    None without a seed, or for one seed whose standard error is unknown.

    Examples:
        >>> interval([SampleMean(100, 40.0, 1.0)]).each("{:.2f}".format)
        Interval(value='40.00', low='38.04', high='41.96')
    """
    k, errors = len(means), [mean.standard_error for mean in means]
    if k == 0 or errors == [None]:
        return None
    values = np.array([mean.value for mean in means])
    half_width = stats.norm.ppf(0.975) * np.mean([error or 0.0 for error in errors])
    if k > 1:
        half_width = np.hypot(stats.t.ppf(0.975, k - 1) * values.std(ddof=1) / np.sqrt(k), half_width)
    mean, half_width = float(values.mean()), float(half_width)
    return Interval(mean, mean - half_width, mean + half_width)


def _reason(run: Run | None, key: ErrorKey) -> str:
    """Why a run has no error: a state, and details."""
    if run is None:
        return "missing"
    if run.state == "finished" and key.estimate == "eight views":
        return "no eight views: repeat its command with evaluation.eight_views=true"
    if run.state == "finished":
        return "no sample: none of its test samples lies in the central half"
    return f"{run.state}: {run.detail}" if run.detail else run.state

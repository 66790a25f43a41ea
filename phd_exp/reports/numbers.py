"""All numbers of a report as one long table, of which every other table is a pivot."""

import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from scipy import special

from phd_exp.evaluation.fusion import FusionScores
from phd_exp.evaluation.point_errors import SampleMean, paired
from phd_exp.metrics.bootstrap import Interval
from phd_exp.records.choices import PLAIN_RECIPE, preset_and_recipe
from phd_exp.records.errors import one_line
from phd_exp.records.searches import Search
from phd_exp.reports.measured import Measured
from phd_exp.reports.runs import Run
from phd_exp.reports.table import printable

COLUMNS = ("run", "subject", "split", "quantity", "method", "value", "low", "high", "n")
"""Columns of the long table: a number, its 95 % interval, the number of samples, and what it is.

- `run`: preset/data set/model/name of a run's folder; with the name `seeds` the mean over seeds; `search/NAME/TRIAL`.
- `subject`: the samples: `whole` or `central` half of the field of view, a stratum, a shift, `3 cameras, free`, ...
- `split`: `test`, `held-out`, `shift`, `views` or `sequences`.
- `quantity`: a key of `SCORES`.
- `n`: 0 where the record does not tell it.
- `method`: the estimate, fusion or smoother. `..., calibrated` is the median of calibrated predictions with its 95 %
  interval, `..., exact` the value of exact densities, `..., minus X` the paired difference to X.
"""
AS_TRAINED, RECALIBRATED, CALIBRATED, EXACT = "as trained", "recalibrated", ", calibrated", ", exact"
FACTS = (
    *("path", "preset", "data", "model", "run", "digest", "words", "state", "detail", "camera", "images", "command"),
    *("git_commit", "machine", "seed"),
)
"""What tables show of a run with its numbers. All texts are printable; `words` are the overrides."""
SAME = ("preset", "data", "model", "digest", "words", "subject", "split", "quantity", "method")
Line = tuple[Any, ...]


def lines_of(run: Run) -> Iterator[Line]:
    """The numbers of a run in the order of `COLUMNS`, without the first."""
    splits = {"test": (run.errors, run.nll), "held-out": (run.held_out_errors, run.held_out_nll)}
    for split, (errors, nll) in splits.items():
        for key, mean in errors.items():
            yield key.reading, split, f"{key.quantity}_error_mm", key.estimate, *_of_samples(mean), mean.n
        if nll is not None:
            n = max((mean.n for mean in errors.values()), default=0)
            yield "whole", split, "nll", "", float(nll), math.nan, math.nan, n
    yield from _of_images(run.measured)
    yield from _of_several(run.measured)


def _of_several(found: Measured) -> Iterator[Line]:
    """Shifted images, several cameras, and sequences."""
    for name, shift in found.shifts.items():
        yield from _bands(printable(name), "shift", AS_TRAINED, shift.scores, shift.n)
    if found.pairs:
        yield from _bands("2 cameras", "views", AS_TRAINED, found.pairs.scores, found.pairs.n)
    if found.fusion:
        yield from _fused(found.fusion)
    for tracks in found.tracks.values():
        subject = f"{tracks.frames} frames, {cameras(tracks.cameras)}"
        for at, band in tracks.bands.items():
            quantity, _, method = at.rpartition("/")
            yield subject, "sequences", quantity, method, *_ends(band), tracks.n


def _of_images(found: Measured) -> Iterator[Line]:
    for method, one in ((AS_TRAINED, found.before), (RECALIBRATED, found.after)):
        if one:
            yield from _bands("whole", "test", method, one.scores, one.n)
            yield from _bands("whole", "test", method + CALIBRATED, one.reference, one.n)
    for stratum in found.before.strata if found.before else ():
        yield from _bands(stratum.label, "test", AS_TRAINED, stratum.scores, stratum.n)
    for name in ("projected", "depth") if found.temperature else ():
        factor = float(getattr(found.temperature, name))
        yield "whole", "held-out", f"temperature_{name}", AS_TRAINED, factor, math.nan, math.nan, 0


def _fused(scores: FusionScores) -> Iterator[Line]:
    exact = {at: Interval(value, math.nan, math.nan) for at, value in scores.exact.items()}
    for suffix, bands in (("", scores.bands), (EXACT, exact)):
        for at, band in bands.items():
            quantity, method, k, ground = at.split("/")
            yield f"{cameras(int(k))}, {ground}", "views", quantity, method + suffix, *_ends(band), scores.n
    errors = {"correlation_of_views": scores.correlation, "correlation_with_size": scores.with_size}
    yield from _bands(cameras(scores.views), "views", AS_TRAINED, errors, scores.n)


def cameras(n: int) -> str:
    """A number of cameras in words."""
    return f"{n} camera{'s' if n > 1 else ''}"


def _bands(subject: str, split: str, method: str, bands: Mapping[str, Interval[float]], n: int) -> Iterator[Line]:
    for quantity, band in bands.items():
        yield subject, split, quantity, method, *_ends(band), n


def _ends(band: Interval[float]) -> tuple[float, float, float]:
    return float(band.value), float(band.low), float(band.high)


def _of_samples(mean: SampleMean) -> tuple[float, float, float]:
    """A mean with 1.96 standard errors over its samples."""
    half = math.nan if mean.standard_error is None else special.ndtri(0.975) * mean.standard_error
    return mean.value, mean.value - half, mean.value + half


def facts_of(run: Run) -> tuple[Any, ...]:
    """The `FACTS` of a run."""
    status = run.status
    made = (command_of(run), status.git_commit or "", status.machine or "") if status else ("", "", "")
    place = run.path, run.preset, run.data, run.model, run.name, run.digest
    known = run.overrides or "", run.state, run.detail, run.config.get("camera.focal_length", ""), run.measured.images
    texts = *place, *known, *made
    return *map(one_line, texts), None if run.seed is None else int(run.seed)


def command_of(run: Run) -> str:
    """The command line that makes a run."""
    preset, recipe = preset_and_recipe(run.preset)
    words = [f"preset={preset}", f"data={run.data}", f"model={run.model}", f"seed={run.seed}"]
    words += [f"recipe={recipe}"] if recipe != PLAIN_RECIPE else []
    words += run.status.overrides if run.status else []
    return one_line(shlex.join(["python", "-m", "phd_exp", *words]))


def trials_of(search: Search) -> list[dict[str, Any]]:
    """The trials of a search as rows; numbers are short in their overrides."""
    return [
        {
            "search": one_line(search.name),
            "trial": trial.number + 1,
            "state": trial.state,
            "value": trial.value,
            "overrides": one_line(" ".join(f"{key}={_short(value)}" for key, value in trial.overrides.items())),
            "run": printable(trial.run),
            "place": float(trial.number),
        }
        for trial in search.trials
    ]


def _short(text: str) -> str:
    try:
        return f"{float(text):.4g}"
    except ValueError:
        return text


def numbers_of(runs: Sequence[Run], searches: Sequence[Search] = ()) -> pd.DataFrame:
    """The numbers of all runs and searches, with the columns `COLUMNS`."""
    rows = [(run.path, *line) for run in runs for line in lines_of(run)]
    for search in searches:
        rows += [
            (
                *(f"search/{one['search']}/{one['trial']}", one["overrides"], "held-out"),
                *(one_line(search.objective), one["state"], one["value"], math.nan, math.nan, 1),
            )
            for one in trials_of(search)
        ]
    return pd.DataFrame(rows, columns=list(COLUMNS))


def over_seeds(found: pd.DataFrame) -> pd.DataFrame:
    """Means over seeds of equal configurations, with 95 % intervals, mean ± sqrt(w_samples² + w_seeds²).

    - w_samples, of another test set: half the width of a seed's own interval, averaged, since seeds share samples.
    - w_seeds, of another training: t s / sqrt(k), where s is the standard deviation over k seeds and t the 97.5 %
      quantile of Student's law with k - 1 degrees of freedom. It is left out for one seed, which cannot tell it.

    The columns are those of `SAME`, `value`, `low`, `high`, `seeds` and `n`, the smallest number of samples. Bounds
    are missing for one seed without an interval.
    """
    half = (found["high"] - found["low"]) / 2
    groups = found.assign(half=half.fillna(0), known=half.notna()).groupby(list(SAME), sort=False)
    means = groups.agg(
        value=("value", "mean"), spread=("value", "std"), half=("half", "mean"), known=("known", "any"),
        seeds=("value", "size"), n=("n", "min"),
    ).reset_index()  # fmt: skip
    k = means["seeds"]
    of_seeds = special.stdtrit(np.maximum(k - 1, 1), 0.975) * means["spread"] / np.sqrt(k)
    width = np.hypot(of_seeds.fillna(0), means["half"]).where(means["known"] | (k > 1))
    return means.assign(low=means["value"] - width, high=means["value"] + width)


def differences(found: pd.DataFrame, by: str, reference: str) -> pd.DataFrame:
    """Paired differences over seeds to the rows whose column `by` is the `reference`, tested on the same images.

    The columns are those of `SAME`, `value`, `low`, `high`, `seeds`, `n` and `p`, the p-value of no difference.
    """
    same = [*(name for name in SAME if name not in (by, "digest" if by == "words" else "words")), "images", "n"]
    rows = []
    for _, alike in found.groupby(same, sort=False):
        of = dict(iter(alike.groupby(by, sort=False)))
        values = {name: dict(zip(map(int, part["seed"]), part["value"], strict=True)) for name, part in of.items()}
        for name in values.keys() - {reference} if reference in values else ():
            gap, p = paired(values[name], values[reference])
            shared = len(values[name].keys() & values[reference].keys())
            first = of[name].iloc[0]
            rows.append([*first[list(SAME)], gap.value, gap.low, gap.high, shared, first["n"], p])
    return pd.DataFrame(rows, columns=[*SAME, "value", "low", "high", "seeds", "n", "p"])


def as_long(found: pd.DataFrame, suffix: str = "") -> pd.DataFrame:
    """Rows over seeds with the columns `COLUMNS`."""
    name = "seeds" + ("-" + found["digest"]).where(found["digest"] != "", "")
    path = found["preset"] + "/" + found["data"] + "/" + found["model"] + "/" + name
    return found.assign(run=path, method=found["method"] + suffix)[list(COLUMNS)]

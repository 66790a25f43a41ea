"""All tables of a report except the paper's: pivots of its numbers."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from phd_exp.evaluation.fusion import FusionScores
from phd_exp.evaluation.point_errors import significant
from phd_exp.evaluation.tracks import SMOOTHERS, TrackScores
from phd_exp.metrics.bootstrap import Interval
from phd_exp.records.choices import in_words
from phd_exp.records.runs import UNSHIFTED
from phd_exp.reports.kinds import BREAKS, KINDS, LEAST, OF_THE_DETAILS, WANTED
from phd_exp.reports.numbers import AS_TRAINED, CALIBRATED, EXACT, RECALIBRATED, cameras, over_seeds, trials_of
from phd_exp.reports.quantities import METHODS, NOTHING, SCORES, mark
from phd_exp.reports.report import Report
from phd_exp.reports.runs import PROBABILISTIC, Run
from phd_exp.reports.table import Table, TableCell, printable

CALIBRATION = (
    "depth_ence",
    "projected_ence",
    "miscalibration_area",
    "depth_pit_area",
    "group_miscalibration",
    "nees",
)
COVERAGE = "inside_90"  # best at 90 %, so that no difference is better
HEADS = ("nll", "depth_crps_mm", COVERAGE, "log_volume", "projected_error_mm", "depth_error_mm", "fused_error_mm")
SHIFTED = (
    *(COVERAGE, "inside_50", "inside_99", "inside_conformal", "unfamiliar", "auroc", "nll", "projected_error_mm"),
    *("depth_error_mm", "depth_ence", "projected_ence", "depth_sharpness_mm", "projected_sharpness_mrad"),
)
AXES = {"variants": "data sets", "scenes": "scenes", "images": "images and focal lengths"}
"""Axis of the shifts -> its name in a title."""
FUSED = ("depth_error_mm", "distance_mm", "coverage_50", "coverage_90", "coverage_99", "normalised_squared_error")
TRACKED = (
    *("depth_error_mm", "projected_error_mm", "hidden/depth_error_mm", "hidden/projected_error_mm"),
    *("ratio/depth_error_mm", "ratio/hidden/depth_error_mm", "gain", "nees"),
)
VARIED = ("nll", "projected_error_mm", "depth_error_mm")
MOST = 10  # trials of a table
ONE_SEED = "†"


def other_tables(report: Report) -> Iterator[Table]:
    """All tables for which there are runs; the report notes those that cannot be made."""
    for make in (heads, calibration, ensembles, shifts, variations, fusion, tracks, searches):
        yield from report.notes.attempt(partial(_all, make, report), f"{make.__name__}: ") or []


def _all(make: Callable[[Report], Iterator[Table]], report: Report) -> list[Table]:
    return list(make(report))


def _in_order(found: pd.DataFrame, **orders: Sequence[Any]) -> pd.DataFrame:
    """The rows whose columns have these values, in the order of the values, otherwise as they are."""
    for column, order in orders.items():
        found = found[found[column].isin(list(order))]
    places = [found[column].map(list(order).index) for column, order in orders.items()]
    return found.iloc[np.lexsort([np.arange(len(found)), *reversed(places)])].copy()


def _over(found: pd.DataFrame, *columns: str) -> Iterator[tuple[Any, ...]]:
    return zip(*(found[column] for column in columns), strict=True)


def _with_cells(found: pd.DataFrame) -> pd.DataFrame:
    """With a heading of the quantity, and the value with its interval as the cell."""
    scores = found["quantity"].map(SCORES)
    cells = [
        TableCell(score.text(value), score.band(low, high))
        for score, (value, low, high) in zip(scores, _over(found, "value", "low", "high"), strict=True)
    ]
    return found.assign(heading=[score.axis for score in scores], cell=cells)


def _mean(row: Any, below: str = "", bold: bool = False) -> TableCell:
    """The cell of a mean over seeds."""
    score = SCORES[row.quantity]
    spread = score.half(row.value, row.low, row.high)
    return TableCell(score.text(row.value), spread + ONE_SEED * (row.seeds == 1 and bool(spread)), below, bold)


def heads(report: Report) -> Iterator[Table]:
    """Densities of different shapes on the same images, compared with the Projected Huber density by paired tests.

    A table for every preset, data set and overrides with runs of `probabilistic` and of other densities.
    """
    every = report.gaps[PROBABILISTIC]
    for key, part in report.densities.groupby(["preset", "data", "digest"], sort=False):
        models = sorted(part["model"].unique(), key=lambda model: (model != PROBABILISTIC, model))
        if models[0] != PROBABILISTIC or len(models) == 1:
            continue
        runs = part.groupby("model")["path"].nunique()  # a score needs every run of its model
        part = part[part.groupby(["model", "quantity"])["path"].transform("nunique") == part["model"].map(runs)]
        part = _in_order(part, model=models, quantity=HEADS)
        gaps = every[(every["preset"] == key[0]) & (every["data"] == key[1]) & (every["digest"] == key[2])]
        gaps = gaps.merge(part[["model", "quantity"]].drop_duplicates(), on=["model", "quantity"])
        preset, data, digest = key
        title = f"Densities on {data}, {in_words(preset)}" + (f", overrides {digest}" if digest else "")
        names = [preset, data, *([digest] if digest else [])]
        lines, cells = _compared(part, gaps)
        yield KINDS["heads"].table("heads", names, lines, title, cells, preset=preset)


def _compared(part: pd.DataFrame, gaps: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The lines of a table of densities, and its cells."""
    of = {(row.model, row.quantity): row for row in gaps.itertuples()}
    sure = significant({key: row.p for key, row in of.items() if key[1] != COVERAGE})
    better = {key for key in sure if of[key].value < 0}
    keys = list(_over(part, "model", "quantity"))
    ends = {name: [getattr(of.get(key), name, None) for key in keys] for name in ("value", "low", "high")}
    lines = part.assign(
        difference=ends["value"], low=ends["low"], high=ends["high"], better=[key in better for key in keys]
    )
    cells = []
    means = over_seeds(part)
    for row in means.itertuples():
        gap, score = of.get((row.model, row.quantity)), SCORES[row.quantity]
        below = f"{score.signed(gap.value)} {score.half(gap.value, gap.low, gap.high)}".rstrip() if gap else ""
        cells.append(_mean(row, below, (row.model, row.quantity) in better))
    seeds = {model: _listed(one["seed"]) for model, one in part.groupby("model")}
    return lines, means.assign(
        heading=[SCORES[name].axis for name in means["quantity"]],
        cell=cells,
        breaks=means["model"].map(lambda model: BREAKS.get(model, NOTHING)),
        seeds=means["model"].map(seeds),
    )


def _listed(seeds: pd.Series) -> str:
    return ", ".join(map(str, sorted(set(seeds))))


def calibration(report: Report) -> Iterator[Table]:
    """Scores of calibration for every preset, each with the interval of a calibrated model."""
    kinds, keys = [AS_TRAINED, RECALIBRATED], ["path", "method", "quantity"]
    scores = report.select(split="test", subject="whole", method=kinds)
    found = report.select(split="test", subject="whole", method=[kind + CALIBRATED for kind in kinds])
    found = found.assign(method=found["method"].str.removesuffix(CALIBRATED)).rename(columns={"value": "calibrated"})
    found = found.merge(scores[[*keys, "value"]], on=keys)
    found["label"] = found["model"] + " on " + found["data"] + ", " + found["run"]
    found["label"] += found["method"].map({AS_TRAINED: "", RECALIBRATED: f", {RECALIBRATED}"})
    found["heading"] = [SCORES[name].label for name in found["quantity"]]
    found["cell"] = [
        _marked(*line) if line[0] in CALIBRATION else None
        for line in _over(found, "quantity", "value", "calibrated", "low", "high")
    ]
    for preset, part in found.groupby("preset"):
        shown = _in_order(part, path=part["path"].unique(), method=kinds, quantity=CALIBRATION)
        title = f"Calibration, {in_words(preset)}: distances on the test samples"
        yield KINDS["calibration"].table("calibration", [preset], part, title, shown, preset=preset)


def _marked(quantity: str, value: float, calibrated: float, low: float, high: float) -> TableCell:
    score, arrow = SCORES[quantity], mark(value, Interval(calibrated, low, high))
    return TableCell(score.text(value), arrow, score.band(low, high), tone="off" if arrow else "")


def ensembles(report: Report) -> Iterator[Table]:
    """A table for every preset with two seeds of one configuration, or with a record of eight views."""
    found = _with_cells(report.ensembles)
    found["label"] = (found["model"] + " on " + found["data"] + " " + found["digest"]).str.rstrip()
    for preset, part in found.groupby("preset"):
        title = f"Ensembles, {in_words(preset)}: scores on the test samples"
        yield KINDS["ensembles"].table("ensembles", [preset], part, title, preset=preset)


def shifts(report: Report) -> Iterator[Table]:
    """For every preset with shifts, for each score and each axis, a matrix of runs by shifts."""
    every = {(run.path, printable(name)): one for run in report.runs for name, one in run.measured.shifts.items()}
    found = report.select(split="shift")
    places = [every[place] for place in _over(found, "path", "subject")]
    found = found.assign(change=[one.change for one in places], left_out=[one.left_out for one in places])
    found["label"] = found["data"] + ", " + found["camera"]
    for preset, of_preset in found.groupby("preset"):
        changes = dict(sorted(set(_over(of_preset, "subject", "change"))))
        for key in SHIFTED:
            of_key = of_preset[of_preset["quantity"] == key]
            for axis, title in AXES.items():
                own = {name: change for name, change in changes.items() if change and _axis(change) == axis}
                part = _in_order(of_key, path=of_key["path"].unique(), subject=(UNSHIFTED, *own))
                if part["subject"].nunique() < 2:
                    continue
                is_main = key == COVERAGE
                part = _with_cells(part).assign(axis=axis, heading=part["subject"])
                part["cell"] = [
                    _in_matrix(is_main, *line) for line in _over(part, "cell", "value", "low", "high")
                ]  # fmt: skip
                described = (f"{name}: {change}." for name, change in own.items())
                yield KINDS["shifts"].table(
                    "shifts",
                    [key, preset, axis],
                    part,
                    f"{SCORES[key].axis} under shift, {in_words(preset)}: {title}",
                    preset=preset,
                    reading="" if is_main else "details",
                    notes=(*(KINDS["shifts"].notes if is_main else (OF_THE_DETAILS,)), *described),
                )


def _axis(change: str) -> str:
    if change.startswith("data."):
        return "variants" if "data.variant=" in change else "scenes"
    return "images"


def _in_matrix(is_main: bool, cell: TableCell, value: float, low: float, high: float) -> TableCell:
    """Coverage with arrows where it is not as promised; of other scores the interval as the second line."""
    if not is_main:
        return TableCell(cell.ours, below=cell.spread)
    if low <= WANTED <= high:
        return TableCell(cell.ours)
    if value < LEAST:
        return TableCell(cell.ours, "↓↓", tone="broken")
    return TableCell(cell.ours, "↓" if value < WANTED else "↑", tone="off")


def variations(report: Report) -> Iterator[Table]:
    """The contribution of each part of a recipe: runs with other overrides compared with those without.

    Both are compared on held-out images, of the training split and never trained on, so that choices made by them are
    independent of the test samples, which all other tables use.
    """
    every = report.gaps[""]
    for (preset, data, model), part in report.held_out.groupby(["preset", "data", "model"], sort=False):
        means = over_seeds(part)
        judged = "nll" if "nll" in set(means["quantity"]) else "depth_error_mm"
        best = means[means["quantity"] == judged].sort_values("value")["words"]
        order = ["", *(words for words in best if words)]
        if len(order) == 1 or "" not in set(part["words"]):
            continue
        gaps = every[
            (every["preset"] == preset) & (every["data"] == data) & (every["model"] == model)
            & (every["quantity"] == judged)
        ]  # fmt: skip
        shown = _in_order(means, words=order, quantity=VARIED)
        shown = shown.assign(
            heading=[SCORES[name].axis for name in shown["quantity"]], cell=list(map(_mean, shown.itertuples()))
        )
        differences = gaps.assign(heading="difference", cell=list(map(_difference, gaps.itertuples())))
        shown = _in_order(pd.concat([shown, differences]), words=order)
        seeds = {words: _listed(one["seed"]) for words, one in part.groupby("words")}
        shown = shown.assign(
            label=shown["words"].replace("", "none"), of=shown["words"].map(seeds), is_varied=shown["words"] != ""
        )
        title = f"Variations of {in_words(preset)}: {model} on {data}, held-out images"
        lines = _in_order(part, words=order, quantity=VARIED)
        names = [preset, data, model]
        yield KINDS["variations"].table("variations", names, lines, title, shown, preset=preset)


def _difference(gap: Any) -> TableCell:
    score = SCORES[gap.quantity]
    return TableCell(score.signed(gap.value), score.half(gap.value, gap.low, gap.high))


def fusion(report: Report) -> Iterator[Table]:
    """A table of each run with a record of several views: a column per number of cameras, a line per method."""
    for run in report.runs:
        if scores := run.measured.fusion:
            yield fusion_table(report, run, scores)


def fusion_table(report: Report, run: Run, scores: FusionScores) -> Table:
    """The table of a run's scores."""
    found = report.select(run=run.path, split="views")
    exact = {
        (subject, quantity, method.removesuffix(EXACT)): value
        for subject, quantity, method, value in _over(found, "subject", "quantity", "method", "value")
        if method.endswith(EXACT)
    }
    found = _with_cells(found[found["method"].isin(METHODS)])
    found[["cameras", "ground"]] = found["subject"].str.extract(r"(\d+) cameras?, (\w+)")
    found["exact"] = [exact.get(place) for place in _over(found, "subject", "quantity", "method")]
    found["cell"] = [
        TableCell(cell.ours, cell.spread, "" if pd.isna(value) else f"{value:.1f}")
        for cell, value in _over(found, "cell", "exact")
    ]
    found["label"] = found["heading"] + found["ground"].map({"free": "", "ground": ", ground"})
    found = found.assign(way=found["method"].map(METHODS), heading=[cameras(int(k)) for k in found["cameras"]])
    shown = _in_order(found, ground=("free", "ground"), quantity=FUSED, method=list(METHODS))
    apart = "" if (run.data, run.model) == ("scale", PROBABILISTIC) else f"{run.title}, "
    title = f"Fusion, {in_words(run.preset)}, {apart}{run.name}: {scores.n} scenes seen by {scores.views} cameras"
    notes = (*KINDS["fusion"].notes, *_of_fusion(scores))
    names = [run.preset, run.data, run.model, run.name]
    return KINDS["fusion"].table("fusion", names, found, title, shown, preset=run.preset, notes=notes)


def _of_fusion(scores: FusionScores) -> Iterator[str]:
    views, size = scores.correlation, scores.with_size
    yield (
        "Fusion assumes that the views' errors are independent. Those of log depth of two views of a scene have the "
        f"correlation {views.value:.2f} ({views.low:.2f}–{views.high:.2f}), their average has {size.value:.2f} with "
        "log size. A size that is common to all views of an object shifts all of them."
    )
    if scores.left_out:
        yield (
            f"{scores.left_out} further scenes are left out: a prediction was not finite, or no position is in front "
            "of every camera."
        )


def tracks(report: Report) -> Iterator[Table]:
    """A table of each run with sequences: a column per length of the sequences, a line per method."""
    for run in report.runs:
        if run.measured.tracks:
            yield tracks_table(report, run, run.measured.tracks)


def tracks_table(report: Report, run: Run, scores: Mapping[str, TrackScores]) -> Table:
    """The table of a run's scores."""
    every = {f"{one.frames} frames, {cameras(one.cameras)}": one for one in scores.values()}
    every = dict(sorted(every.items(), key=lambda item: (item[1].frames, item[1].cameras)))
    found = report.select(run=run.path, split="sequences")
    found = _in_order(found, quantity=TRACKED, method=list(METHODS), subject=list(every))
    found["quantity"] = found["quantity"].replace("nees", "normalised_squared_error")
    found = _with_cells(found).rename(columns={"heading": "label"})
    found["quantity"] = found["quantity"].replace("normalised_squared_error", "nees")
    of = [every[subject] for subject in found["subject"]]
    found = found.assign(
        way=found["method"].map(METHODS),
        heading=[f"{one.n} × {one.name}" for one in of],
        frames=[one.frames for one in of],
        cameras=[one.cameras for one in of],
        n_hidden=[one.hidden for one in of],
    )
    notes = (*KINDS["tracks"].notes, *(note for one in every.values() for note in _of_tracks(one)))
    names = [run.preset, run.data, run.model, run.name]
    title = f"Paths, {in_words(run.preset)}, {run.title}, {run.name}"
    return KINDS["tracks"].table("tracks", names, found, title, preset=run.preset, notes=notes)


def _of_tracks(scores: TrackScores) -> Iterator[str]:
    noise, slow, whole = scores.choice.noise, scores.choice.slow, scores.choice.correlated
    noises = ", ".join(f"{noise[method]:.2g} ({METHODS[method]})" for method in SMOOTHERS)
    yield (
        f"Held-out sequences from {cameras(scores.cameras)} have a speed of {scores.choice.speed:.2g} m/s. They "
        f"determine the noise of the motion, in m/s² per √Hz: {noises}. Their errors have the time constants "
        f"{whole.depth_time:.2g} s of depth and {whole.projection_time:.2g} s of the projection by autocorrelation; "
        f"weighted frames use {slow.depth_time:.2g} s and {slow.projection_time:.2g} s, with which the true held-out "
        "positions were most likely."
    )
    left = f" {scores.left_out} further sequences are left out." if scores.left_out else ""
    frames = f"{scores.hidden} of {scores.n * scores.frames} frames of the sequences of {scores.name}"
    yield f"{frames} hide the object.{left}"


def searches(report: Report) -> Iterator[Table]:
    """The best trials of every search."""
    for search in report.searches:
        found = pd.DataFrame(trials_of(search), dtype=object)
        counts = found["state"].value_counts()
        states = ", ".join(
            f"{counts[one]} {one}" for one in ("finished", "pruned", "failed", "running") if one in counts
        )
        found = found.assign(
            heading=search.objective, cell=[None if v is None else TableCell(f"{v:.4g}") for v in found["value"]]
        )
        best = found[(found["state"] == "finished") & found["value"].notna()].sort_values("value").head(MOST)
        yield KINDS["searches"].table("searches", [search.name], found, f"Search {search.name}: {states}", best)

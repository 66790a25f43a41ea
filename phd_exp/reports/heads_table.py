"""Densities of different shapes on the same images, compared with the Projected Huber density by paired tests."""

from collections.abc import Sequence

import numpy as np

from phd_exp.distributions.constraints import findings
from phd_exp.evaluation.point_errors import SampleMean, difference
from phd_exp.records.choices import in_words
from phd_exp.reports.cells import interval
from phd_exp.reports.quantities import SCORES
from phd_exp.reports.runs import PROBABILISTIC, Report, Run
from phd_exp.reports.table import NOTHING, Table, TableCell, TableRow, file_stem

COLUMNS = ("nll", "depth_crps_mm", "coverage_90", "projected_error_mm", "depth_error_mm")
OF_A_CELL = (
    "A cell: the mean over seeds with its 95 % interval; below it the difference to the probabilistic model with its "
    "95 % interval, a bootstrap over seeds and the shared test images. Bold: better than the probabilistic model by "
    "that test; never one seed, and never coverage, which is best at 0.9."
)
OF_THE_CONSTRAINTS = "Breaks: which of the seven constraints the density violates, as measured on its head."


def heads_tables(report: Report) -> list[Table]:
    """A table for every preset and data set with runs of the probabilistic model and of other densities."""
    places = dict.fromkeys((run.preset, run.data) for run in report.runs)
    found = {place: _densities(report, *place) for place in places}
    return [_table(*place, models) for place, models in found.items() if PROBABILISTIC in models and len(models) > 1]


def _densities(report: Report, preset: str, data: str) -> dict[str, list[Run]]:
    """The runs of each model with a density, in the order of its seeds; the probabilistic model is the first."""
    models = {run.model for run in report.runs if (run.preset, run.data) == (preset, data) and _scores(run)}
    return {
        model: [run for _, run in sorted(report.at_defaults(preset, data, model).items()) if _scores(run)]
        for model in sorted(models, key=lambda model: (model != PROBABILISTIC, model))
    }


def _scores(run: Run) -> bool:
    return run.state == "finished" and run.measured.before is not None and "nll" in run.measured.before.scores


def _means(runs: Sequence[Run], name: str) -> list[SampleMean]:
    found = [run.measured.before for run in runs if run.measured.before]
    return [SampleMean(e.n, e.scores[name].value, None, np.array(e.resampled[name])) for e in found]


def _table(preset: str, data: str, models: dict[str, list[Run]]) -> Table:
    broken: dict[str, list[str]] = {}
    for constraint, row in findings().items():
        for model, finding in row.items():
            broken.setdefault(model, []).extend([] if finding.holds else [constraint[0]])
    rows = []
    for model, runs in models.items():
        breaks = ", ".join(broken[model]) or "none" if model in broken else NOTHING
        cells = tuple(_cell(name, runs, models[PROBABILISTIC]) for name in COLUMNS)
        rows.append(TableRow((model, breaks, ", ".join(str(run.seed) for run in runs)), cells))
    return Table(
        stem=file_stem("heads", preset, data),
        kind="heads",
        title=f"Densities on {data}, {in_words(preset)}",
        stub=("model", "breaks", "seeds"),
        columns=tuple(SCORES[name].axis for name in COLUMNS),
        groups=(tuple(rows),),
        notes=(OF_A_CELL, OF_THE_CONSTRAINTS),
        below="difference",
        preset=preset,
        numbers=tuple(
            {"preset": preset, "data": data, "model": model, "seed": run.seed, "quantity": name, "value": mean.value}
            for model, runs in models.items()
            for name in COLUMNS
            for run, mean in zip(runs, _means(runs, name), strict=True)
        ),
    )


def _cell(name: str, runs: Sequence[Run], reference: Sequence[Run]) -> TableCell:
    means, text = _means(runs, name), SCORES[name].text
    half_width = interval(means).half_width
    spread = "" if half_width is None else f"±{text(half_width)}"
    value = text(interval(means).mean)
    if runs is reference or len({run.measured.images for run in (*runs, *reference)}) > 1:
        return TableCell(value, spread)
    gap, width = difference(means, _means(reference, name))
    sign = "+" if gap > 0 else ""
    bold = gap < -width and name != "coverage_90"
    return TableCell(value, spread, f"{sign}{text(gap)} ±{text(width)}", bold)

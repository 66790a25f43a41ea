"""Densities of different shapes on the same images, compared with the Projected Huber density by paired tests."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from phd_exp.evaluation.point_errors import SampleMean, paired, significant
from phd_exp.metrics.bootstrap import Interval
from phd_exp.records.choices import in_words
from phd_exp.reports.cells import interval
from phd_exp.reports.quantities import SCORES
from phd_exp.reports.runs import PROBABILISTIC, Report, Run
from phd_exp.reports.table import NOTHING, Table, TableCell, TableRow, bounds, file_stem, plus_minus

FUSED = "fused_error_mm"
COLUMNS = ("nll", "depth_crps_mm", "inside_90", "log_volume", "projected_error_mm", "depth_error_mm", FUSED)
COVERAGE = "inside_90"  # best at 90 %, so that no difference is better
OF_A_CELL = (
    "A cell: the mean over seeds with its 95 % interval; below it the difference to the probabilistic model with its "
    "95 % interval, a paired t-test over seeds. Bold: better than the probabilistic model by "
    "that test, corrected for the number of comparisons in the table (Holm, 5 %); never one seed or coverage. "
    "Breaks: the constraints that the head violates, of the paper's seven."
)
BREAKS: Mapping[str, str] = {
    "gaussian": "3, 6",
    "gaussian_mixture": "3, 5, 6",
    "student_t": "3, 5, 6",
    "decomposed": "5",
}
"""Model -> the constraints that its head violates; tests/distributions/test_constraints.py measures them."""


def heads_tables(report: Report) -> list[Table]:
    """A table for every preset, data set and overrides with runs of `probabilistic` and of other densities."""
    found: dict[tuple[str, str, str], dict[str, list[Run]]] = {}
    for run in sorted(report.runs, key=lambda run: (run.digest, run.model != PROBABILISTIC)):
        before = run.measured.before
        if run.state == "finished" and before and "nll" in before.scores:
            found.setdefault((run.preset, run.data, run.digest), {}).setdefault(run.model, []).append(run)
    return [_table(*place, models) for place, models in found.items() if PROBABILISTIC in models and len(models) > 1]


def _means(runs: Sequence[Run], name: str) -> list[SampleMean]:
    """One mean for each run; empty if any run has not recorded the score."""
    every = [run.measured.pairs if name == FUSED else run.measured.before for run in runs]
    found = [e for e in every if e and name in e.scores]
    if len(found) < len(runs):
        return []
    return [SampleMean(e.n, e.scores[name].value, None) for e in found]


def _table(preset: str, data: str, digest: str, models: dict[str, list[Run]]) -> Table:
    rows = []
    means = {(model, name): _means(runs, name) for model, runs in models.items() for name in COLUMNS}
    columns = [name for name in COLUMNS if any(means[model, name] for model in models)]
    gaps = {(model, name): _gap(models, means, model, name) for model in models for name in columns}
    known = {place: gap for place, gap in gaps.items() if gap and place[1] != COVERAGE}
    sure = significant({place: p_value for place, (_, p_value) in known.items()})
    for model, runs in models.items():
        stub = (model, BREAKS.get(model, NOTHING), ", ".join(str(run.seed) for run in runs))
        cells = []
        for name in columns:
            gap, _ = gaps[model, name] or (None, 1.0)
            cells.append(_cell(name, runs, means[model, name], gap, (model, name) in sure))
        rows.append(TableRow(stub, tuple(cells)))
    return Table(
        stem=file_stem("heads", preset, data, *([digest] if digest else [])),
        kind="heads",
        title=f"Densities on {data}, {in_words(preset)}" + (f", overrides {digest}" if digest else ""),
        stub=("model", "breaks", "seeds"),
        columns=tuple(SCORES[name].axis for name in columns),
        groups=(tuple(rows),),
        notes=(OF_A_CELL,),
        below="difference",
        preset=preset,
    )


def _gap(
    models: dict[str, list[Run]], means: dict[tuple[str, str], list[SampleMean]], model: str, name: str
) -> tuple[Interval[float], float] | None:
    """The difference to the probabilistic model; None for that model itself, or tests on other images."""
    ours, others = means[model, name], means[PROBABILISTIC, name]
    runs = (*models[model], *models[PROBABILISTIC])
    same = {(run.measured.images, mean.n) for run, mean in zip(runs, (*ours, *others), strict=False)}
    if model == PROBABILISTIC or not ours or not others or len(same) > 1:
        return None
    by_seed = (
        {run.seed or 0: mean.value for run, mean in zip(models[name], found, strict=True)}
        for name, found in ((model, ours), (PROBABILISTIC, others))
    )
    return paired(*by_seed)


def _cell(
    name: str, runs: Sequence[Run], means: Sequence[SampleMean], gap: Interval[float] | None, is_sure: bool
) -> TableCell:
    text = SCORES[name].text
    if not means:
        return TableCell(NOTHING)
    is_better = is_sure and gap is not None and gap.value < 0
    against = {"difference": gap.value if gap else None, **bounds(gap), "better": is_better}
    numbers = tuple(
        run.choice | {"overrides": run.digest, "seed": run.seed, "quantity": name, "value": mean.value} | against
        for run, mean in zip(runs, means, strict=True)
    )
    mean = float(np.mean([mean.value for mean in means]))
    alone = TableCell(text(mean), plus_minus(interval(means), text), numbers=numbers)
    if gap is None:
        return alone
    below = f"{'+' if gap.value > 0 else ''}{text(gap.value)} {plus_minus(gap, text)}"
    return replace(alone, below=below, bold=is_better)

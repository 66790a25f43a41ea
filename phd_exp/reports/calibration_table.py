"""Distances from calibration, each beside the value that a calibrated model of the same predictions has."""

from collections.abc import Sequence

from phd_exp.evaluation.predictions import Evaluation
from phd_exp.evaluation.reference import DISTANCES
from phd_exp.records.choices import in_words
from phd_exp.reports.quantities import SCORES
from phd_exp.reports.runs import Report, Run
from phd_exp.reports.table import Table, TableCell, TableRow, file_stem

RECALIBRATED = "recalibrated"
OF_A_CELL = (
    "A cell: the distance of the run's predictions; below it the 95 % interval of calibrated predictions with the "
    "same uncertainties (truths simulated from them). Finitely many samples never give zero: a "
    "value above that interval is miscalibrated, a value inside it is not distinguishable from calibrated."
)


def calibration_tables(report: Report) -> list[Table]:
    """A table for every preset that has a measured distribution."""
    tables = []
    for preset in report.presets:
        runs = [run for run in report.runs if run.preset == preset and _evaluations(run)]
        if runs:
            tables.append(_table(preset, runs))
    return tables


def _table(preset: str, runs: Sequence[Run]) -> Table:
    return Table(
        stem=file_stem("calibration", preset),
        kind="calibration",
        title=f"Calibration, {in_words(preset)}: distances on the test samples",
        stub=("run",),
        columns=tuple(SCORES[name].label for name in DISTANCES),
        groups=tuple(tuple(_rows(run)) for run in runs),
        notes=(OF_A_CELL,),
        below="calibrated",
        preset=preset,
        numbers=tuple(
            {"preset": preset, "data": run.data, "model": run.model, "run": run.name, "predictions": kind}
            | {"quantity": name, "value": measured.scores[name].value}
            | dict(zip(("calibrated", "low", "high"), vars(measured.reference[name]).values(), strict=True))
            for run in runs
            for kind, measured in _evaluations(run)
            for name in DISTANCES
        ),
    )


def _evaluations(run: Run) -> list[tuple[str, Evaluation]]:
    found = (("as trained", run.measured.before), (RECALIBRATED, run.measured.after))
    return [(kind, measured) for kind, measured in found if measured and measured.reference]


def _rows(run: Run) -> list[TableRow]:
    return [
        TableRow(
            (f"{run.title}, {run.name}{', recalibrated' if kind == RECALIBRATED else ''}",),
            tuple(_cell(measured, name) for name in DISTANCES),
        )
        for kind, measured in _evaluations(run)
    ]


def _cell(measured: Evaluation, name: str) -> TableCell:
    text, reference = SCORES[name].text, measured.reference[name]
    return TableCell(
        text(measured.scores[name].value), below=f"({text(reference.low)}–{text(reference.high)})"
    )

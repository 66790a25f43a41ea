"""Scores of calibration, each with the interval of a calibrated model that predicts the same uncertainties."""

from phd_exp.evaluation.predictions import Evaluation
from phd_exp.records.choices import in_words
from phd_exp.reports.quantities import SCORES, mark
from phd_exp.reports.runs import Report, Run
from phd_exp.reports.table import Table, TableCell, TableRow, file_stem

COLUMNS = ("depth_ence", "projected_ence", "miscalibration_area", "depth_pit_area", "group_miscalibration", "nees")
OF_A_CELL = (
    "A cell: the score of the run's predictions; below it the 95 % interval of calibrated predictions with the same "
    "uncertainties (truths simulated from them). Finitely many samples never give zero: a value outside that "
    "interval (↑, ↓) is miscalibrated, a value inside it is not distinguishable from calibrated. Coverage and CRPS: "
    "calibration.csv."
)


def calibration_tables(report: Report) -> list[Table]:
    """A table for every preset with an evaluated distribution."""
    found = {
        preset: [(run, kinds) for run in report.runs if run.preset == preset and (kinds := _evaluations(run))]
        for preset in report.presets
    }
    return [
        Table(
            stem=file_stem("calibration", preset),
            kind="calibration",
            title=f"Calibration, {in_words(preset)}: distances on the test samples",
            stub=("run",),
            columns=tuple(SCORES[name].label for name in COLUMNS),
            groups=tuple(tuple(_row(run, *kind) for kind in kinds.items()) for run, kinds in runs),
            notes=(OF_A_CELL,),
            below="calibrated",
            preset=preset,
            numbers=tuple(
                {"preset": preset, "data": run.data, "model": run.model, "run": run.name, "predictions": kind}
                | {"quantity": name, "value": evaluation.scores[name].value}
                | dict(zip(("calibrated", "low", "high"), vars(reference).values(), strict=True))
                for run, kinds in runs
                for kind, evaluation in kinds.items()
                for name, reference in evaluation.reference.items()
            ),
        )
        for preset, runs in found.items()
        if runs
    ]


def _evaluations(run: Run) -> dict[str, Evaluation]:
    found = {"as trained": run.measured.before, "recalibrated": run.measured.after}
    return {kind: evaluation for kind, evaluation in found.items() if evaluation and evaluation.reference}


def _row(run: Run, kind: str, evaluation: Evaluation) -> TableRow:
    label = f"{run.title}, {run.name}{', recalibrated' if kind == 'recalibrated' else ''}"
    cells = []
    for name in COLUMNS:
        text, value, reference = SCORES[name].text, evaluation.scores[name].value, evaluation.reference[name]
        below, arrow = f"({text(reference.low)}–{text(reference.high)})", mark(value, reference)
        cells.append(TableCell(text(value), arrow, below, tone="off" if arrow else ""))
    return TableRow((label,), tuple(cells))

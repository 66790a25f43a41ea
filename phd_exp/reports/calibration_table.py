"""Scores of calibration, each with the interval of a calibrated model that predicts the same uncertainties."""

from dataclasses import replace

from phd_exp.metrics.bootstrap import Interval
from phd_exp.records.choices import in_words
from phd_exp.reports.quantities import SCORES, mark
from phd_exp.reports.runs import Report, Run
from phd_exp.reports.table import Table, TableCell, TableRow, bounds, file_stem

COLUMNS = ("depth_ence", "projected_ence", "miscalibration_area", "depth_pit_area", "group_miscalibration", "nees")
OF_A_CELL = (
    "A cell: the score of the run's predictions; below it the 95 % interval of calibrated predictions with the same "
    "uncertainties (truths simulated from them). Finitely many samples never give zero: a value outside that "
    "interval (↑, ↓) is miscalibrated, a value inside it is not distinguishable from calibrated. Coverage and CRPS: "
    "calibration.csv."
)


def calibration_tables(report: Report) -> list[Table]:
    """A table for every preset with an evaluated distribution."""
    found = [(run, _rows(run)) for run in report.runs]
    of_presets = {preset: [rows for run, rows in found if run.preset == preset and rows] for preset in report.presets}
    return [
        Table(
            stem=file_stem("calibration", preset),
            kind="calibration",
            title=f"Calibration, {in_words(preset)}: distances on the test samples",
            stub=("run",),
            columns=tuple(SCORES[name].label for name in COLUMNS),
            groups=tuple(
                tuple(TableRow((label,), tuple(cells[name] for name in COLUMNS)) for label, cells in rows.items())
                for rows in groups
            ),
            notes=(OF_A_CELL,),
            below="calibrated",
            preset=preset,
            cells=tuple(cell for rows in groups for cells in rows.values() for cell in cells.values()),
        )
        for preset, groups in of_presets.items()
        if groups
    ]


def _rows(run: Run) -> dict[str, dict[str, TableCell]]:
    """Label -> cell of each score, of the predictions as trained and recalibrated."""
    label, found = f"{run.title}, {run.name}", {"as trained": run.measured.before, "recalibrated": run.measured.after}
    return {
        label if kind == "as trained" else f"{label}, {kind}": {
            name: _cell(run, kind, name, evaluation.scores[name].value, reference)
            for name, reference in evaluation.reference.items()
        }
        for kind, evaluation in found.items()
        if evaluation and evaluation.reference
    }


def _cell(run: Run, kind: str, name: str, value: float, calibrated: Interval[float]) -> TableCell:
    text, arrow = calibrated.each(SCORES[name].text), mark(value, calibrated)
    line = run.choice | {"run": run.name, "predictions": kind, "quantity": name, "value": value}
    line |= {"calibrated": calibrated.value, **bounds(calibrated)}
    cell = TableCell(SCORES[name].text(value), arrow, f"({text.low}–{text.high})", numbers=(line,))
    return replace(cell, tone="off") if arrow else cell

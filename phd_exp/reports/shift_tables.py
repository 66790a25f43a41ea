"""Tests under distribution shift: for each score a matrix of runs by shifts, first the share inside 90 % regions."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby

from phd_exp.records.choices import in_words
from phd_exp.records.runs import UNSHIFTED
from phd_exp.reports.quantities import SCORES
from phd_exp.reports.runs import Report, Run
from phd_exp.reports.table import NOTHING, Table, TableCell, TableRow, file_stem, printable

AXES = {"variants": "data sets", "scenes": "scenes", "images": "images and focal lengths"}
"""Axis of the shifts -> its name in a title."""
MAIN = "inside_90"
WANTED, LEAST = 90, 80  # per cent inside the 90 % region: of a calibrated run, and below which the promise is broken
DETAILS = (
    *("inside_50", "inside_99", "inside_conformal", "unfamiliar", "auroc", "nll", "projected_error_mm"),
    *("depth_error_mm", "depth_ence", "projected_ence", "depth_sharpness_mm", "projected_sharpness_mrad"),
)
OF_THE_MATRIX = (
    f"Per cent of truths inside the predicted 90 % region. Arrow: the 95 % interval excludes {WANTED} %; two: fewer "
    f"than {LEAST} % are inside. Home: the unchanged test samples. The files and the site have all scores."
)
OF_THE_DETAILS = "In brackets: 95 % bootstrap intervals over test samples. Home: the unchanged test samples."


def shift_tables(report: Report) -> list[Table]:
    """For every preset with shifts a matrix for each score and each axis."""
    runs = [run for run in report.runs if run.measured.shifts]
    presets = [list(alike) for _, alike in groupby(runs, key=lambda run: run.preset)]
    keys = [(key, axis) for key in (MAIN, *DETAILS) for axis in AXES]
    tables = [_matrix(alike, key, axis) for alike in presets for key, axis in keys]
    return [table for table in tables if table.numbers and len(table.columns) > 1]


def _matrix(runs: Sequence[Run], key: str, axis: str) -> Table:
    """A row for each run of a preset, a column for each shift of an axis."""
    found = sorted((name, shift.change) for run in runs for name, shift in run.measured.shifts.items())
    changes = {name: change for name, change in found if change and _axis(change) == axis}
    preset, names = runs[0].preset, (UNSHIFTED, *changes)
    rows = [
        TableRow((f"{run.data}, {_camera(run)}", run.name), tuple(_cell(run, axis, name, key) for name in names))
        for run in runs
    ]
    return Table(
        stem=file_stem("shifts", key, preset, axis),
        kind="shifts",
        title=f"{SCORES[key].axis} under shift, {in_words(preset)}: {AXES[axis]}",
        stub=("trained on, camera", "run"),
        columns=tuple(map(printable, names)),
        groups=tuple(tuple(alike) for _, alike in groupby(rows, key=lambda row: row.stub[0].partition(",")[0])),
        notes=(
            OF_THE_MATRIX if key == MAIN else OF_THE_DETAILS,
            *(f"{printable(name)}: {change}." for name, change in changes.items()),
        ),
        below="95 %",
        preset=preset,
        reading="" if key == MAIN else "details",
    )


def _camera(run: Run) -> str:
    return run.config.get("camera.focal_length", "")


def _axis(change: str) -> str:
    if change.startswith("data."):
        return "variants" if "data.variant=" in change else "scenes"
    return "images"


def _cell(run: Run, axis: str, name: str, key: str) -> TableCell:
    shift = run.measured.shifts.get(name)
    band = shift.scores.get(key) if shift else None
    if shift is None or band is None:
        return TableCell(NOTHING)
    line = run.choice | {"run": run.name, "camera": _camera(run), "axis": axis, "shift": name}
    line |= {"n": shift.n, "left_out": shift.left_out, "quantity": key, **vars(band)}
    text = band.each(SCORES[key].text)
    cell = TableCell(text.value, numbers=(line,))
    if key != MAIN:
        return replace(cell, below=f"({text.low}–{text.high})")
    if band.low <= WANTED <= band.high:
        return cell
    if band.value < LEAST:
        return replace(cell, spread="↓↓", tone="broken")
    return replace(cell, spread="↓" if band.value < WANTED else "↑", tone="off")

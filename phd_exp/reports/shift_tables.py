"""Tests under distribution shift: a matrix of runs by shifts, and every score of a run."""

from collections.abc import Mapping, Sequence
from itertools import groupby

from phd_exp.evaluation.reference import Band
from phd_exp.evaluation.shifts import ShiftScores
from phd_exp.records.choices import in_words
from phd_exp.records.runs import HOME
from phd_exp.reports.runs import Report, Run
from phd_exp.reports.table import NOTHING, Table, TableCell, TableRow, file_stem, printable

DETAILS = "shift_details"  # the kind of the tables of all scores
AXES = {"variants": "other data sets", "scenes": "other scenes", "images": "changed images and focal lengths"}
"""Axis of shifts -> its name in a title."""
WANTED, LEAST = 90, 80  # per cent inside the 90 % region: of a calibrated run, and below which the promise is broken
COLUMNS = {
    "projected_error_mm": ("projected (mm)", 1),
    "depth_error_mm": ("depth (mm)", 0),
    "nll": ("NLL", 2),
    "inside_50": ("in 50 %", 0),
    "inside_90": ("in 90 %", 0),
    "inside_99": ("in 99 %", 0),
    "inside_conformal": ("in conformal 90 %", 0),
    "depth_ence": ("depth ENCE", 2),
    "projected_ence": ("projected ENCE", 2),
    "depth_sharpness_mm": ("depth sd (mm)", 0),
    "projected_sharpness_mrad": ("projected sd (mrad)", 2),
}
"""Score -> its heading and its decimals."""
OF_THE_MATRIX = (
    f"A cell: per cent of truths inside the predicted 90 % region. Arrow: its 95 % interval lacks {WANTED}; "
    f"two arrows: fewer than {LEAST} % are inside. Home: the unchanged test samples. The tables of each run have all "
    "scores, with intervals."
)
OF_THE_DETAILS = (
    "In brackets: 95 % bootstrap intervals over test samples. In 50, 90 and 99 %: per cent of truths inside these "
    "credible regions. Conformal: inside the region whose level is the 90 % quantile of held-out samples. sd: root "
    "mean square of the predicted standard deviation."
)


def shift_tables(report: Report) -> list[Table]:
    """For every preset, a matrix per axis of shifts; then the scores of every run with a shift."""
    runs = [run for run in report.runs if run.measured.shifts]
    of_presets = [(preset, list(alike)) for preset, alike in groupby(runs, key=lambda run: run.preset)]
    matrices = [matrix(preset, alike, axis) for preset, alike in of_presets for axis in AXES]
    return [*(table for table in matrices if len(table.columns) > 1), *map(shift_details, runs)]


def matrix(preset: str, runs: Sequence[Run], axis: str) -> Table:
    """The share of truths inside the 90 % region: a row for each run, a column for each shift of an axis."""
    changes: dict[str, set[str]] = {}
    for run in runs:
        for name, found in run.measured.shifts.items():
            if name != HOME and _axis(found) == axis:
                changes.setdefault(name, set()).add(found.change)
    names = [HOME, *sorted(changes)]
    return Table(
        stem=file_stem("shifts", preset, axis),
        kind="shifts",
        title=f"Inside the 90 % region, {in_words(preset)}: {AXES[axis]}",
        stub=("trained on", "camera", "run"),
        columns=tuple(map(printable, names)),
        groups=tuple(
            tuple(
                TableRow((run.data, _camera(run), run.name), tuple(_share(run, name) for name in names)) for run in of
            )
            for _, of in groupby(runs, key=lambda run: run.data)
        ),
        notes=(OF_THE_MATRIX, *(f"{printable(name)}: {' or '.join(sorted(changes[name]))}" for name in names[1:])),
        preset=preset,
        numbers=tuple(
            {"preset": preset, "axis": axis, "data": run.data, "model": run.model, "run": run.name}
            | {"camera": _camera(run), "shift": name, "inside_90": band.value, "low": band.low, "high": band.high}
            for run in runs
            for name in names
            if (band := _inside(run, name))
        ),
    )


def shift_details(run: Run) -> Table:
    """Every score of a run: a row for each shift."""
    shifts = run.measured.shifts
    by_axis = [[HOME], *([name for name in shifts if name != HOME and _axis(shifts[name]) == axis] for axis in AXES)]
    return Table(
        stem=file_stem("shift", run.preset, run.data, run.model, run.name),
        kind=DETAILS,
        title=f"Shifts, {in_words(run.preset)}: {run.title}, {run.name}, camera={_camera(run)}",
        stub=("tested on", "samples"),
        columns=tuple(heading for heading, _ in COLUMNS.values()),
        groups=tuple(tuple(_row(name, shifts[name]) for name in names) for names in by_axis if names),
        notes=(OF_THE_DETAILS, *_left_out(shifts)),
        below="95 %",
        preset=run.preset,
        numbers=tuple(
            {"preset": run.preset, "data": run.data, "model": run.model, "run": run.name, "camera": _camera(run)}
            | {"shift": name, "change": found.change, "n": found.n, "left_out": found.left_out}
            | {"quantity": key, "value": band.value, "low": band.low, "high": band.high}
            for name, found in shifts.items()
            for key, band in found.scores.items()
        ),
    )


def _axis(found: ShiftScores) -> str:
    if not found.change.startswith("data."):
        return "images"
    return "variants" if "data.variant=" in found.change else "scenes"


def _camera(run: Run) -> str:
    return run.config.get("camera.focal_length", "")


def _inside(run: Run, name: str) -> Band | None:
    found = run.measured.shifts.get(name)
    return found.scores.get("inside_90") if found else None


def _share(run: Run, name: str) -> TableCell:
    band = _inside(run, name)
    if band is None:
        return TableCell(NOTHING)
    if band.low <= WANTED <= band.high:
        return TableCell(f"{band.value:.0f}")
    if band.value < LEAST:
        return TableCell(f"{band.value:.0f}", "↓↓", tone="broken")
    return TableCell(f"{band.value:.0f}", "↓" if band.value < WANTED else "↑", tone="off")


def _row(name: str, found: ShiftScores) -> TableRow:
    cells = (_cell(found.scores.get(key), digits) for key, (_, digits) in COLUMNS.items())
    return TableRow((printable(name), str(found.n)), tuple(cells))


def _cell(band: Band | None, digits: int) -> TableCell:
    if band is None:
        return TableCell(NOTHING)
    value, low, high = (f"{number:.{digits}f}" for number in (band.value, band.low, band.high))
    return TableCell(value, below=f"({low}–{high})")


def _left_out(shifts: Mapping[str, ShiftScores]) -> list[str]:
    counts = ", ".join(f"{printable(name)} {found.left_out}" for name, found in shifts.items() if found.left_out)
    return [f"Left out, because a prediction is not finite: {counts}."] if counts else []

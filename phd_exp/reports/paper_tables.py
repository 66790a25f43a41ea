"""The paper's two tables in both readings, for every preset with any of their runs."""

import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

from phd_exp.evaluation.point_errors import COLUMNS, READINGS, ErrorKey, Quantity, Reading
from phd_exp.records.choices import PLAIN_RECIPE, in_words, preset_and_recipe
from phd_exp.records.errors import one_line
from phd_exp.reports.cells import Cell, make_cell
from phd_exp.reports.paper import ASSUMED, BELOW_BOUND, LAYOUTS, OF_A_BOUND, Column, Layout, Line, TableName
from phd_exp.reports.runs import PROBABILISTIC, Report, Run
from phd_exp.reports.table import NOTHING, Table, TableCell, TableRow, file_stem, plus_minus

DIGITS: dict[Quantity, int] = {"projected": 1, "depth": 0}  # decimals of a millimetre, as in the paper
ONE_SEED = "†"
FEWER_SEEDS = "‡"

IN_WORDS: dict[Reading, str] = {
    "whole": "the whole field of view",
    "central": "the central half of the field of view",
}
OF_THE_READING: dict[Reading, str] = {
    "whole": "Test samples: all, over the whole field of view, as in the paper's text.",
    "central": "Test samples: those in the central half of the field of view, |v_p| ≤ 1/2 in both coordinates, where "
    "the authors' generator places all objects. The networks were trained on the whole field of view.",
}
OF_A_CELL = (
    "A cell: our mean error in mm; below it the paper's figure and (× ours / paper). Bold: smaller than every other "
    "model of its column by a 95 % paired test, a bootstrap over seeds and the shared test images; never one seed."
)
OF_THE_SPLITS = "Held-out training samples chose the recipe and fitted the temperatures. Test samples chose nothing."
OF_AN_INTERVAL = {
    "seeds_and_samples": "±: 95 % interval of the mean, over seeds (Student's t) and test samples.",
    "samples": f"±{ONE_SEED}: one seed; 1.96 standard errors over its test samples. It does not say how another "
    "training would differ.",
    "none": "No ±: one seed, one test sample.",
}
OF_FEWER_SEEDS = f"{FEWER_SEEDS}: fewer seeds than other cells of this table."


def paper_tables(report: Report) -> list[Table]:
    """Both tables in both readings, for every preset that has any of a table's runs."""
    tables = []
    for preset in report.presets:
        for layout in LAYOUTS:
            begun = {choice: runs for choice in layout.choices if (runs := report.at_defaults(preset, *choice))}
            seeds = sorted({seed for runs in begun.values() for seed in runs})
            shown = _begun(layout, begun)
            tables += [_table(report, preset, layout, shown, reading, seeds) for reading in READINGS if begun]
    return tables


def _begun(layout: Layout, begun: Mapping[tuple[str, str], Mapping[int, Run]]) -> Layout:
    """The columns and lines with a run; all estimates, but eight views only if a run has recorded them."""
    data, models = ({choice[place] for choice in begun} for place in (0, 1))
    estimates = {*COLUMNS, *(key.estimate for runs in begun.values() for run in runs.values() for key in run.errors)}
    groups = (
        tuple(line for line in group if line.model in models and line.estimate in estimates)
        for group in layout.groups
    )
    columns = tuple(column for column in layout.columns if column.data in data)
    return replace(layout, columns=columns, groups=tuple(filter(None, groups)))


def _table(report: Report, preset: str, layout: Layout, shown: Layout, reading: Reading, seeds: list[int]) -> Table:
    """The table of a layout, reduced to the columns and lines of `shown`."""

    def cell(line: Line, column: Column) -> Cell:
        key = ErrorKey(line.estimate, reading, line.error(column))
        return make_cell(report, preset, column.data, line.model, key, seeds)

    measured = [[(line, [cell(line, one) for one in shown.columns]) for line in group] for group in shown.groups]
    cells = [one for group in measured for _, row in group for one in row]
    best = _best([one for _, row in measured[0] for one in row])
    gaps = dict.fromkeys((reason, one.model, one.data, n) for one in cells for n, reason in one.gaps.items())
    left_out = _left_out(layout, shown)
    can_be_made = left_out or any(not reason.startswith("no sample") for reason, *_ in gaps)
    rows = [tuple(_row(line, row, layout.name, best) for line, row in group) for group in measured]
    return Table(
        stem=file_stem(layout.name, preset, reading),
        kind="tables",
        title=f"The paper's {layout.title}, {one_line(in_words(preset))}: {IN_WORDS[reading]}{_samples(cells)}",
        stub=("model", "error (mm)") if layout.by_line else ("model",),
        columns=tuple(f"{c.quantity} error (mm)" if c.quantity else c.data for c in shown.columns),
        groups=(*rows, tuple(_bound_rows(shown))),
        notes=(*_notes(layout, reading, cells), *left_out),
        below="paper (ratio)",
        gaps=tuple(gap_lines(gaps)),
        command=making_command(report, preset, layout.name, seeds) if can_be_made else "",
        preset=preset,
        reading=reading,
    )


def _left_out(layout: Layout, shown: Layout) -> list[str]:
    """One line that names the columns and rows without a run."""
    columns = [column.data for column in layout.columns if column not in shown.columns]
    models = {line.model for group in shown.groups for line in group}
    lines = [line.model for group in layout.groups for line in group if line.model not in models]
    names = ", ".join(dict.fromkeys([*columns, *lines]))
    return [f"Left out of {layout.title}, without a run: {names}."] if names else []


def _best(cells: Sequence[Cell]) -> set[int]:
    """The ids of the cells that are significantly better than every other of their data set and error."""
    best = set()
    for cell in cells:
        column = [one for one in cells if (one.data, one.key.quantity) == (cell.data, cell.key.quantity)]
        others = [one for one in column if one.means and one is not cell]
        if cell.means and others and all(map(cell.beats, others)):
            best.add(id(cell))
    return best


def _row(line: Line, cells: Sequence[Cell], table: TableName, best: set[int]) -> TableRow:
    label = f"{line.model} ({line.estimate})" if line.model == PROBABILISTIC else line.model
    stub = (label, line.quantity) if line.quantity else (label,)
    return TableRow(stub, tuple(_table_cell(cell, table, id(cell) in best) for cell in cells))


def _table_cell(cell: Cell, table: TableName, bold: bool) -> TableCell:
    paper = "" if cell.published is None else _number(cell.key.quantity, cell.published)
    if cell.mean is None:
        return TableCell(cell.state, below=paper, numbers=(cell.numbers(table, bold),))
    if cell.ratio is not None:
        paper += f" (×{cell.ratio:.2f})"
    number, numbers = _number(cell.key.quantity, cell.mean), (cell.numbers(table, bold),)
    return TableCell(number, _spread(cell), paper, bold, numbers=numbers)


def _spread(cell: Cell) -> str:
    marks = BELOW_BOUND if _is_below(cell) else ""
    marks += FEWER_SEEDS if cell.gaps else ""
    if cell.scatter == "samples":
        marks = ONE_SEED + marks
    return plus_minus(cell.interval, partial(_number, cell.key.quantity)) + marks


def _is_below(cell: Cell) -> bool:
    return cell.mean is not None and cell.bound is not None and cell.mean < cell.bound


def _number(quantity: Quantity, value: float) -> str:
    return f"{value:.{DIGITS[quantity]}f}"


def _bound_rows(shown: Layout) -> Iterator[TableRow]:
    """The rows of bounds on depth error that a column has."""
    for label, bounds in shown.bounds.items():
        known = [None if column.quantity == "projected" else bounds.get(column.data) for column in shown.columns]
        if any(known):
            cells = (TableCell(f"{bound:.0f}" if bound else NOTHING) for bound in known)
            yield TableRow((label, "depth") if shown.by_line else (label,), tuple(cells))


def _notes(layout: Layout, reading: Reading, cells: Sequence[Cell]) -> list[str]:
    """The notes that explain the contents of a table."""
    kinds = {cell.scatter for cell in cells if cell.means}
    notes = [OF_THE_READING[reading], OF_A_CELL]
    notes += [text for kind, text in OF_AN_INTERVAL.items() if kind in kinds]
    if any(cell.means and cell.gaps for cell in cells):
        notes.append(OF_FEWER_SEEDS)
    if any(map(_is_below, cells)):
        notes.append(OF_A_BOUND)
    return [*notes, ASSUMED, layout.note, OF_THE_SPLITS]


def _samples(cells: Sequence[Cell]) -> str:
    """The number of test samples; a range if runs were tested on different numbers of them."""
    counts = sorted({mean.n for cell in cells for mean in cell.means.values()})
    if not counts:
        return ""
    return f", {' to '.join(map(str, dict.fromkeys([counts[0], counts[-1]])))} test samples"


def gap_lines(gaps: Iterable[tuple[str, str, str, int]]) -> list[str]:
    """The missing runs (reason, model, data set, seed) in words: a line for each reason, model and list of seeds."""
    seeds: dict[tuple[str, str, str], list[int]] = {}
    for reason, model, data, seed in gaps:
        seeds.setdefault((reason, model, data), []).append(seed)
    lines: dict[tuple[str, str, str], list[str]] = {}
    for (reason, model, data_set), found in seeds.items():
        numbers = f"seed{'s' if len(found) > 1 else ''} {', '.join(map(str, found))}"
        lines.setdefault((reason, model, numbers), []).append(data_set)
    return [f"{model} on {', '.join(data)} ({numbers}): {reason}" for (reason, model, numbers), data in lines.items()]


def making_command(report: Report, preset: str, name: TableName, seeds: Iterable[int] = (0,)) -> str:
    """The command line that makes the missing runs of a table."""
    preset, recipe = preset_and_recipe(preset)
    words = [f"experiment={name}", f"preset={preset}"]
    if recipe != PLAIN_RECIPE:
        words.append(f"recipe={recipe}")
    if list(seeds) != [0]:
        words.append(f"seed={','.join(map(str, seeds))}")
    if report.folder.as_posix() != "runs":
        words.append(f"runs={report.folder}")
    return one_line(shlex.join(["python", "-m", "phd_exp", "-m", *words]))

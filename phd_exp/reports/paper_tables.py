"""The paper's two tables in both readings, for every preset with any of their runs."""

import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import chain, product

from phd_exp.evaluation.point_errors import COLUMNS, READINGS, ErrorKey, Estimate, Quantity, Reading
from phd_exp.records.choices import PLAIN_RECIPE, in_words, preset_and_recipe
from phd_exp.records.errors import one_line
from phd_exp.reports.cells import Cell, make_cell
from phd_exp.reports.paper import ASSUMED, BELOW_BOUND, LAYOUTS, OF_A_BOUND, Layout, TableName
from phd_exp.reports.runs import PROBABILISTIC, Report, Run
from phd_exp.reports.table import NOTHING, Table, TableCell, TableRow, file_stem, plus_minus

DIGITS: dict[Quantity, int] = {"projected": 1, "depth": 0}  # decimals of a millimetre, as in the paper
OTHERS: tuple[Estimate, ...] = ("mean", "median", "eight views")  # of the density; the paper reports its mode alone
Begun = Mapping[tuple[str, str], Mapping[int, Run]]
"""(data set, model) -> seed -> run, where there are any."""
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
    "model of its column by a 95 % paired t-test over seeds; never one seed."
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
            choices = product(layout.data, layout.models)
            begun = {choice: runs for choice in choices if (runs := report.at_defaults(preset, *choice))}
            tables += [_table(report, preset, layout, begun, reading) for reading in READINGS if begun]
    return tables


def _table(report: Report, preset: str, layout: Layout, begun: Begun, reading: Reading) -> Table:
    """The table of a layout, reduced to the data sets and models with a run."""
    data = [name for name in layout.data if any(name == choice[0] for choice in begun)]
    models = [name for name in layout.models if any(name == choice[1] for choice in begun)]
    seeds = sorted({seed for runs in begun.values() for seed in runs})
    is_by_line = len(layout.data) > 1  # whether each error has a line

    def rows(model: str, estimate: Estimate) -> list[list[Cell]]:
        keys = [ErrorKey(estimate, reading, quantity) for quantity in DIGITS]
        cells = [[make_cell(report, preset, name, model, key, seeds) for name in data] for key in keys]
        return cells if is_by_line else [[*chain(*cells)]]

    measured = [[row for line in group for row in rows(*line)] for group in _groups(models, begun)]
    cells = [cell for group in measured for row in group for cell in row]
    best = _best([*chain(*measured[0])])
    gaps = dict.fromkeys((reason, one.model, one.data, n) for one in cells for n, reason in one.gaps.items())
    left_out = ", ".join(name for name in (*layout.data, *layout.models) if name not in (*data, *models))
    can_be_made = left_out or any(not reason.startswith("no sample") for reason, *_ in gaps)
    groups = [tuple(_row(row, is_by_line, layout.name, best) for row in group) for group in measured]
    return Table(
        stem=file_stem(layout.name, preset, reading),
        kind="tables",
        title=f"The paper's {layout.title}, {in_words(preset)}: {IN_WORDS[reading]}{_samples(cells)}",
        stub=("model", "error (mm)") if is_by_line else ("model",),
        columns=tuple(data if is_by_line else (f"{quantity} error (mm)" for quantity in DIGITS)),
        groups=(*groups, tuple(_bound_rows(layout, data, is_by_line))),
        notes=_notes(layout, reading, cells, left_out),
        below="paper (ratio)",
        gaps=tuple(gap_lines(gaps)),
        command=making_command(report, preset, layout.name, seeds) if can_be_made else "",
        preset=preset,
        reading=reading,
    )


def _groups(models: Sequence[str], begun: Begun) -> Iterator[list[tuple[str, Estimate]]]:
    """The paper's lines, then the density's other estimates; eight views only if a run has recorded them."""
    yield [(model, "mode") for model in models]
    known = {*COLUMNS, *(key.estimate for runs in begun.values() for run in runs.values() for key in run.errors)}
    if PROBABILISTIC in models:
        yield [(PROBABILISTIC, estimate) for estimate in OTHERS if estimate in known]


def _best(cells: Sequence[Cell]) -> set[int]:
    """The ids of the cells that are significantly better than every other of their data set and error."""
    best = set()
    for cell in cells:
        column = [one for one in cells if (one.data, one.key.quantity) == (cell.data, cell.key.quantity)]
        others = [one for one in column if one.means and one is not cell]
        if cell.means and others and all(map(cell.beats, others)):
            best.add(id(cell))
    return best


def _row(cells: Sequence[Cell], is_by_line: bool, table: TableName, best: set[int]) -> TableRow:
    model, key = cells[0].model, cells[0].key
    label = f"{model} ({key.estimate})" if model == PROBABILISTIC else model
    stub = (label, key.quantity) if is_by_line else (label,)
    return TableRow(stub, tuple(_table_cell(cell, table, id(cell) in best) for cell in cells))


def _table_cell(cell: Cell, table: TableName, bold: bool) -> TableCell:
    number, numbers = partial(_number, cell.key.quantity), (cell.numbers(table, bold),)
    paper = "" if cell.published is None else number(cell.published)
    if cell.mean is None:
        return TableCell(cell.state, below=paper, numbers=numbers)
    paper += "" if cell.ratio is None else f" (×{cell.ratio:.2f})"
    marks = {ONE_SEED: cell.scatter == "samples", BELOW_BOUND: cell.is_below_bound, FEWER_SEEDS: bool(cell.gaps)}
    spread = plus_minus(cell.interval, number) + "".join(mark for mark, holds in marks.items() if holds)
    return TableCell(number(cell.mean), spread, paper, bold, numbers=numbers)


def _number(quantity: Quantity, value: float) -> str:
    return f"{value:.{DIGITS[quantity]}f}"


def _bound_rows(layout: Layout, data: Sequence[str], is_by_line: bool) -> Iterator[TableRow]:
    """The rows of bounds on depth error that a column has."""
    for label, bounds in layout.bounds.items():
        known = [*([] if is_by_line else [None]), *map(bounds.get, data)]
        if any(known):
            cells = (TableCell(f"{bound:.0f}" if bound else NOTHING) for bound in known)
            yield TableRow((label, "depth") if is_by_line else (label,), tuple(cells))


def _notes(layout: Layout, reading: Reading, cells: Sequence[Cell], left_out: str) -> tuple[str, ...]:
    """The notes that explain the contents of a table."""
    kinds = {cell.scatter for cell in cells if cell.means}
    notes = {OF_THE_READING[reading]: True, OF_A_CELL: True}
    notes |= {text: kind in kinds for kind, text in OF_AN_INTERVAL.items()}
    notes[OF_FEWER_SEEDS] = any(cell.means and cell.gaps for cell in cells)
    notes[OF_A_BOUND] = any(cell.is_below_bound for cell in cells)
    notes |= {ASSUMED: True, layout.note: True, OF_THE_SPLITS: True}
    notes[f"Left out of {layout.title}, without a run: {left_out}."] = bool(left_out)
    return tuple(text for text, applies in notes.items() if applies)


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

"""The paper's two tables as data: what stands where, in words and figures, whatever draws it.

`tables(collect(runs))` gives them; `phd_exp.reports.formats` writes them for a terminal, Markdown, LaTeX and CSV.
"""

import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from phd_exp.reports.cells import Cell, Gap, Interval, make_cell, seeds_of
from phd_exp.reports.collect import PROBABILISTIC, Records
from phd_exp.reports.paper import ASSUMED, LAYOUTS, Floor, Layout, Line, TableName
from phd_exp.reports.point_errors import READINGS, ErrorKey, Quantity, Reading

DIGITS: dict[Quantity, int] = {"projected": 1, "depth": 0}
"""Decimals of a millimetre, the paper's."""
MOST_DIGITS = 4
NOTHING = "–"
ONE_SEED = "†"
FEWER_SEEDS = "‡"
DEFAULT_RUNS = "runs"

IN_WORDS: dict[Reading, str] = {
    "whole": "the whole field of view",
    "central": "the central half of the field of view",
}
OF_THE_READING: dict[Reading, str] = {
    "whole": "Test samples: all, over the whole field of view, as the paper's text draws them.",
    "central": "Test samples: those in the central half of the field of view, |v_p| ≤ 1/2 in both coordinates, where "
    "the authors' generator places all its objects. The networks were trained on the whole.",
}
OF_A_CELL = (
    "A cell: ours, the mean error in mm; below it the paper's figure and (× ours / paper). Bold (or *): the smallest of "
    "ours on that data set and error; figures that print alike share it, and one model alone gets none."
)
OF_AN_INTERVAL = {
    "student_t_over_seeds": "±: 95 % interval of the mean over seeds, Student's t.",
    "normal_over_samples": f"±{ONE_SEED}: one seed; 1.96 standard errors over its test samples, which says nothing "
    "of how another training would differ.",
    "none": "No ±: one seed, one test sample.",
}
OF_FEWER_SEEDS = f"{FEWER_SEEDS}: fewer seeds than other cells of this table have."


@dataclass(frozen=True)
class TableCell:
    """What stands in one place of a table.

    Attributes:
        ours: a mean, a floor, or why there is no number.
        spread: ± half the interval, with its marks.
        paper: the paper's figure and the ratio to it.
        bold: whether `ours` is the best of its column.
        source: what it was made from; None of a floor.
    """

    ours: str
    spread: str = ""
    paper: str = ""
    bold: bool = False
    source: Cell | None = None


@dataclass(frozen=True)
class TableRow:
    """One line: what it is about, and a cell a column."""

    stub: tuple[str, ...]
    cells: tuple[TableCell, ...]


@dataclass(frozen=True)
class PaperTable:
    """One of the paper's tables, for one preset in one reading.

    Attributes:
        stub: headings of the columns that say what a line is about.
        columns: headings of the columns of cells.
        groups: lines, with a rule between groups: models, the other estimates, floors.
        gaps: runs that are missing, unfinished or unreadable.
        command: what makes them.
        notes: how to read it, a sentence or two each.
    """

    preset: str
    name: TableName
    reading: Reading
    title: str
    stub: tuple[str, ...]
    columns: tuple[str, ...]
    groups: tuple[tuple[TableRow, ...], ...]
    gaps: tuple[Gap, ...]
    command: str
    notes: tuple[str, ...]

    @property
    def rows(self) -> tuple[TableRow, ...]:
        return tuple(row for group in self.groups for row in group)

    @property
    def sources(self) -> list[Cell]:
        """Everything measured, line by line."""
        return [place.source for row in self.rows for place in row.cells if place.source is not None]


def tables(records: Records) -> list[PaperTable]:
    """Both tables in both readings, for every preset that has any of a table's runs."""
    return [
        _table(records, preset, layout, reading, seeds)
        for preset in records.presets
        for layout in LAYOUTS
        if (seeds := seeds_of(records, preset, layout.choices))
        for reading in READINGS
    ]


def gap_lines(gaps: Iterable[Gap]) -> list[str]:
    """A line for each reason and model: which runs a table lacks."""
    lacking: dict[tuple[str, str, str], list[str]] = {}
    for (reason, model, data), seeds in _seeds_by_reason(gaps).items():
        numbers = f"seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))}"
        lacking.setdefault((reason, model, numbers), []).append(data)
    return [
        f"{model} on {', '.join(data)} ({numbers}): {reason}"
        for (reason, model, numbers), data in lacking.items()
    ]


def _seeds_by_reason(gaps: Iterable[Gap]) -> dict[tuple[str, str, str], list[int]]:
    """(reason, model, data set) -> seeds."""
    seeds: dict[tuple[str, str, str], list[int]] = {}
    for gap in gaps:
        reason = f"{gap.state}: {one_line(gap.detail)}" if gap.detail else gap.state
        seeds.setdefault((reason, gap.model, gap.data), []).append(gap.seed)
    return seeds


def making_command(records: Records, preset: str, name: TableName, seeds: Iterable[int] = (0,)) -> str:
    """The command line that makes whatever a table lacks."""
    words = [f"experiment={name}", f"preset={preset}"]
    if list(seeds) != [0]:
        words.append(f"seed={','.join(map(str, seeds))}")
    if records.folder.as_posix() != DEFAULT_RUNS:
        words.append(f"runs={records.folder}")
    return one_line(shlex.join(["python", "-m", "phd_exp", "-m", *words]))


def one_line(text: str) -> str:
    """Text from outside as one line of visible characters: a terminal would obey the others."""
    return "".join(letter if letter.isprintable() else "?" for letter in " ".join(text.split()))


def _table(
    records: Records, preset: str, layout: Layout, reading: Reading, seeds: Sequence[int]
) -> PaperTable:
    measured = [
        [_measured(records, preset, layout, line, reading, seeds) for line in group]
        for group in layout.groups
    ]
    best = _best(cell for group in measured for line in group for cell in line)
    groups = [
        tuple(_row(line, cells, best) for line, cells in zip(lines, group, strict=True))
        for lines, group in zip(layout.groups, measured, strict=True)
    ]
    cells = [cell for group in measured for line in group for cell in line]
    return PaperTable(
        preset=preset,
        name=layout.name,
        reading=reading,
        title=f"{layout.title}, preset {one_line(preset)}: {IN_WORDS[reading]}{_samples(cells)}",
        stub=_stub(layout),
        columns=tuple(
            f"{column.quantity} error (mm)" if column.quantity else column.data for column in layout.columns
        ),
        groups=(*groups, tuple(_floor_row(floor, layout) for floor in layout.floors)),
        gaps=tuple(dict.fromkeys(gap for cell in cells for gap in cell.gaps)),
        command=making_command(records, preset, layout.name, seeds),
        notes=_notes(layout, reading, cells),
    )


def _measured(
    records: Records, preset: str, layout: Layout, line: Line, reading: Reading, seeds: Sequence[int]
) -> list[Cell]:
    return [
        make_cell(
            records,
            preset,
            column.data,
            line.model,
            ErrorKey(line.estimate, reading, line.quantity_in(column)),
            seeds,
        )
        for column in layout.columns
    ]


def _best(cells: Iterable[Cell]) -> dict[tuple[str, Quantity], str]:
    """(data set, error) -> the smallest mean as it is printed, where more than one model has one."""
    means: dict[tuple[str, Quantity], list[tuple[float, str]]] = {}
    for cell in cells:
        if cell.mean is not None:
            means.setdefault((cell.data, cell.key.quantity), []).append((cell.mean, cell.model))
    return {
        place: _number(min(values)[0], place[1])
        for place, values in means.items()
        if len({model for _, model in values}) > 1
    }


def _row(line: Line, cells: Sequence[Cell], best: Mapping[tuple[str, Quantity], str]) -> TableRow:
    label = f"{line.model} ({line.estimate})" if line.model == PROBABILISTIC else line.model
    stub = (label, line.quantity) if line.quantity else (label,)
    return TableRow(stub, tuple(_table_cell(cell, best) for cell in cells))


def _table_cell(cell: Cell, best: Mapping[tuple[str, Quantity], str]) -> TableCell:
    quantity = cell.key.quantity
    paper = "" if cell.published is None else _number(cell.published, quantity)
    if cell.interval is None:
        return TableCell(cell.state, paper=paper, source=cell)
    ours = _number(cell.interval.mean, quantity)
    if cell.ratio is not None:
        paper += f" (×{cell.ratio:.2f})"
    bold = ours == best.get((cell.data, quantity))
    return TableCell(ours, _spread(cell, cell.interval), paper, bold, cell)


def _spread(cell: Cell, interval: Interval) -> str:
    marks = FEWER_SEEDS if cell.gaps else ""
    if interval.half_width is None:
        return marks
    if interval.kind == "normal_over_samples":
        marks = ONE_SEED + marks
    digits = DIGITS[cell.key.quantity]
    while digits < MOST_DIGITS and 0 < interval.half_width < 0.5 * 10.0**-digits:
        digits += 1  # a small interval is not an exact number
    return f"±{interval.half_width:.{digits}f}{marks}"


def _number(value: float, quantity: Quantity) -> str:
    return f"{value:.{DIGITS[quantity]}f}"


def _stub(layout: Layout) -> tuple[str, ...]:
    by_line = all(line.quantity for group in layout.groups for line in group)
    return ("model", "error (mm)") if by_line else ("model",)


def _floor_row(floor: Floor, layout: Layout) -> TableRow:
    stub = (floor.label, "depth") if len(_stub(layout)) > 1 else (floor.label,)
    return TableRow(
        stub,
        tuple(
            TableCell(NOTHING if column.quantity == "projected" else floor.depth.get(column.data, NOTHING))
            for column in layout.columns
        ),
    )


def _notes(layout: Layout, reading: Reading, cells: Sequence[Cell]) -> tuple[str, ...]:
    kinds = {cell.interval.kind for cell in cells if cell.interval}
    notes = [OF_THE_READING[reading], OF_A_CELL]
    notes += [text for kind, text in OF_AN_INTERVAL.items() if kind in kinds]
    if any(cell.interval and cell.gaps for cell in cells):
        notes.append(OF_FEWER_SEEDS)
    return (*notes, ASSUMED, layout.note)


def _samples(cells: Sequence[Cell]) -> str:
    """How many test samples count; a range where runs were tested on different numbers of them."""
    counts = sorted({n for cell in cells for n in cell.n_test})
    if not counts:
        return ""
    return f", {counts[0]} to {counts[-1]} test samples" if len(counts) > 1 else f", {counts[0]} test samples"

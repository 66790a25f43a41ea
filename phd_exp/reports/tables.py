"""The paper's two tables as data: what stands where, in words and figures, whatever draws it.

`tables(collect(runs))` gives them; `phd_exp.reports.formats` writes them for a terminal, Markdown, LaTeX and CSV.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from phd_exp.evaluation.point_errors import READINGS, ErrorKey, Quantity, Reading
from phd_exp.reports.captions import FEWER_SEEDS, ONE_SEED, making_command, notes, title
from phd_exp.reports.cells import Cell, Gap, Interval, make_cell, seeds_of
from phd_exp.reports.collect import PROBABILISTIC, Records
from phd_exp.reports.paper import LAYOUTS, Floor, Layout, Line, TableName

DIGITS: dict[Quantity, int] = {"projected": 1, "depth": 0}
"""Decimals of a millimetre, the paper's."""
MOST_DIGITS = 4
NOTHING = "–"


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


class Table(Protocol):
    """What every format draws; `PaperTable` says what it is. Its files are named by its stem."""

    @property
    def stem(self) -> str:
        """Of its file names."""
        ...

    @property
    def title(self) -> str:
        """What it is headed by."""
        ...

    @property
    def caption(self) -> str:
        """The title as a sentence of its own."""
        ...

    @property
    def stub(self) -> tuple[str, ...]:
        """Headings of the columns that say what a line is about."""
        ...

    @property
    def columns(self) -> tuple[str, ...]:
        """Headings of the columns of cells."""
        ...

    @property
    def groups(self) -> tuple[tuple[TableRow, ...], ...]:
        """Lines, with a rule between groups."""
        ...

    @property
    def gaps(self) -> tuple[Gap, ...]:
        """Runs that are missing, unfinished or unreadable."""
        ...

    @property
    def command(self) -> str:
        """What makes them; empty where no further run would help."""
        ...

    @property
    def notes(self) -> tuple[str, ...]:
        """How to read it, a sentence or two each."""
        ...


@dataclass(frozen=True)
class PaperTable:
    """One of the paper's tables, for one preset in one reading.

    Attributes:
        stub: headings of the columns that say what a line is about.
        columns: headings of the columns of cells.
        groups: lines, with a rule between groups: models, the other estimates, floors.
        gaps: runs that are missing, unfinished or unreadable.
        command: what makes them; empty where no further run would help.
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
    def stem(self) -> str:
        """Of its file names: table, preset and reading."""
        return f"{self.name}-{self.preset}-{self.reading}"

    @property
    def caption(self) -> str:
        """The title as a sentence of its own."""
        return f"The paper's {self.title}"

    @property
    def rows(self) -> tuple[TableRow, ...]:
        """The lines of all groups."""
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


def _table(
    records: Records, preset: str, layout: Layout, reading: Reading, seeds: Sequence[int]
) -> PaperTable:
    measured = [
        [_measured(records, preset, layout, line, reading, seeds) for line in group]
        for group in layout.groups
    ]
    cells = [cell for group in measured for line in group for cell in line]
    best = _best(cells)
    groups = [
        tuple(_row(line, cells, best) for line, cells in zip(lines, group, strict=True))
        for lines, group in zip(layout.groups, measured, strict=True)
    ]
    gaps = tuple(dict.fromkeys(gap for cell in cells for gap in cell.gaps))
    return PaperTable(
        preset=preset,
        name=layout.name,
        reading=reading,
        title=title(preset, layout, reading, cells),
        stub=_stub(layout),
        columns=tuple(
            f"{column.quantity} error (mm)" if column.quantity else column.data for column in layout.columns
        ),
        groups=(*groups, tuple(_floor_row(floor, layout) for floor in layout.floors)),
        gaps=gaps,
        command=making_command(records, preset, layout.name, seeds) if _can_be_made(gaps) else "",
        notes=notes(layout, reading, cells),
    )


def _can_be_made(gaps: Iterable[Gap]) -> bool:
    return any(gap.state != "no sample" for gap in gaps)


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

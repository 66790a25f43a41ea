"""A table as typed cells, from which the terminal, all files and the pages are made."""

import hashlib
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from phd_exp.metrics.bootstrap import Interval
from phd_exp.records.errors import one_line

NOTHING = "–"
LONGEST_STEM = 120


@dataclass(frozen=True)
class TableCell:
    """One number of a table.

    Attributes:
        ours: the number as text, or the reason why it is missing.
        spread: its interval, with its marks.
        below: a second line, such as the paper's figure.
        bold: whether `ours` is significantly the best.
        tone: how bad the number is: "off" for a warning, "broken" for a failure.
        numbers: its lines of CSV at full precision: one, one for each run that it averages, or none.
    """

    ours: str
    spread: str = ""
    below: str = ""
    bold: bool = False
    tone: Literal["", "off", "broken"] = ""
    numbers: tuple[Mapping[str, Any], ...] = ()


@dataclass(frozen=True)
class TableRow:
    """One line of a table: its labels, and a cell per column."""

    stub: tuple[str, ...]
    cells: tuple[TableCell, ...]


@dataclass(frozen=True)
class Table:
    """A table with its notes.

    Attributes:
        stem: of its file names.
        kind: stem of the CSV file that collects the numbers of all tables of a kind.
        stub, columns: headings of the labels, and of the cells.
        groups: lines, with a rule between groups.
        below: the meaning of the cells' second lines.
        notes: explanations, a sentence or two each.
        gaps: missing runs, a line each; `command` makes them.
        cells: all cells in the order of CSV, if some are in no row or the rows have another order.
    """

    stem: str
    kind: str
    title: str
    stub: tuple[str, ...]
    columns: tuple[str, ...]
    groups: tuple[tuple[TableRow, ...], ...]
    notes: tuple[str, ...]
    below: str = ""
    gaps: tuple[str, ...] = ()
    command: str = ""
    preset: str = ""
    reading: str = ""
    cells: tuple[TableCell, ...] = ()

    @property
    def numbers(self) -> list[Mapping[str, Any]]:
        """The lines of CSV of all cells."""
        cells = self.cells or [cell for row in self.rows for cell in row.cells]
        return [line for cell in cells for line in cell.numbers]

    @property
    def rows(self) -> tuple[TableRow, ...]:
        """The lines of all groups."""
        return tuple(row for group in self.groups for row in group)


def bounds(interval: Interval[float] | None) -> dict[str, float | None]:
    """The columns `low` and `high` of CSV."""
    return {"low": interval.low, "high": interval.high} if interval else {"low": None, "high": None}


def plus_minus(interval: Interval[float] | None, text: Callable[[float], str]) -> str:
    """Half the width of a symmetric interval, such as `±3`; empty without one."""
    return f"±{text((interval.high - interval.low) / 2)}" if interval else ""


def printable(name: str) -> str:
    """The name of a file as text that every terminal, file and page can represent."""
    return one_line(os.fsencode(name).decode(errors="replace"))


def file_stem(*names: str) -> str:
    """A file name of at most `LONGEST_STEM` plain characters, different for different names."""
    plain = "-".join(re.sub(r"[^A-Za-z0-9_+-]+", "-", name) for name in names)
    # a hyphen in any name but the last could be mistaken for a joining one
    unmistakable = plain == "-".join(names) and not any("-" in name for name in names[:-1])
    digest = hashlib.sha256("/".join(names).encode(errors="surrogateescape")).hexdigest()[:8]
    return plain if unmistakable and len(plain) <= LONGEST_STEM else f"{plain[:100]}-{digest}"

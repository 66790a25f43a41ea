"""A table as typed cells, from which the terminal, all files and the pages are made."""

import hashlib
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import pandas as pd

from phd_exp.records.errors import one_line
from phd_exp.reports.quantities import NOTHING

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
    """

    ours: str
    spread: str = ""
    below: str = ""
    bold: bool = False
    tone: Literal["", "off", "broken"] = ""


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
        lines: the lines of its CSV file, at full precision.
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
    lines: pd.DataFrame = field(default_factory=pd.DataFrame, repr=False, compare=False)

    @property
    def rows(self) -> tuple[TableRow, ...]:
        """The lines of all groups."""
        return tuple(row for group in self.groups for row in group)


def pivot(
    found: pd.DataFrame, stub: Sequence[str], column: str, group: str
) -> tuple[tuple[str, ...], tuple[tuple[TableRow, ...], ...]]:
    """The headings and the groups of rows of a table, all in the order in which they first occur.

    Args:
        found: a row for each cell, with the columns `stub`, `column`, `group` and `cell`.
    """
    columns = tuple(dict.fromkeys(found[column]))
    groups: dict[Any, dict[tuple[str, ...], dict[str, TableCell]]] = {}
    labels = found[list(stub)].itertuples(index=False, name=None)
    for of, label, heading, cell in zip(found[group], labels, found[column], found["cell"], strict=True):
        groups.setdefault(of, {}).setdefault(label, {})[heading] = cell
    return columns, tuple(
        tuple(TableRow(label, tuple(cells.get(one, TableCell(NOTHING)) for one in columns)) for label, cells in rows)
        for rows in map(dict.items, groups.values())
    )


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

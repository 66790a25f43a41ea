"""A table as data: what stands where, in words and figures, whatever format draws it."""

import hashlib
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from phd_exp.records.errors import one_line
from phd_exp.records.files import write_atomic

NOTHING = "–"
LONGEST_STEM = 120


@dataclass(frozen=True)
class TableCell:
    """What stands in one place of a table.

    Attributes:
        ours: a number, or why there is none.
        spread: its interval, with its marks.
        below: a second line, such as the paper's figure.
        bold: whether `ours` is separated from all its rivals.
    """

    ours: str
    spread: str = ""
    below: str = ""
    bold: bool = False


@dataclass(frozen=True)
class TableRow:
    """One line: what it is about, and a cell a column."""

    stub: tuple[str, ...]
    cells: tuple[TableCell, ...]


@dataclass(frozen=True)
class Table:
    """A table, its reading aids, and its numbers for CSV.

    Attributes:
        stem: of its file names.
        kind: of its CSV file, which holds the numbers of all tables of a kind.
        stub: headings of the columns that say what a line is about; `columns` those of the cells.
        groups: lines, with a rule between groups.
        below: what the second lines of cells are.
        notes: how to read it, a sentence or two each.
        gaps: which runs are missing, a line each; `command` makes them.
        numbers: a mapping a number, at full precision.
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
    numbers: tuple[Mapping[str, Any], ...] = ()
    preset: str = ""
    reading: str = ""

    @property
    def rows(self) -> tuple[TableRow, ...]:
        """The lines of all groups."""
        return tuple(row for group in self.groups for row in group)


def printable(name: str) -> str:
    """A name of a file as text that every terminal, file and page can hold."""
    return one_line(os.fsencode(name).decode(errors="replace"))


def file_stem(*names: str) -> str:
    """A file name of at most `LONGEST_STEM` characters that differs wherever the names differ, whatever they hold."""
    plain = "-".join(re.sub(r"[^A-Za-z0-9_+-]+", "-", name) for name in names)
    # a hyphen in any name but the last could be taken for one that joins them
    unmistakable = plain == "-".join(names) and not any("-" in name for name in names[:-1])
    digest = hashlib.sha256("/".join(names).encode(errors="surrogateescape")).hexdigest()[:8]
    return plain if unmistakable and len(plain) <= LONGEST_STEM else f"{plain[:100]}-{digest}"


def write_text(file: Path, text: str) -> None:
    """Write a file of the report, whole; a letter that no encoding knows becomes `?`. Raises OSError."""
    write_atomic(file, text.encode(errors="replace"))

"""Tables as GitHub's Markdown."""

import re
from collections.abc import Sequence

from phd_exp.reports.table import Table, TableCell, TableRow

SPECIAL = re.compile(r"([\\`*_\[\]<>#|~&@$])")
"""What GitHub may read as markup, a mention, an issue or mathematics."""


def markdown(table: Table) -> str:
    """A heading, the table, what it lacks with the command that makes it, and how to read it."""
    headings = [*table.stub, *table.columns]
    aligned = ["---"] * len(table.stub) + ["---:"] * len(table.columns)
    blank = "|" + " |" * len(headings)
    body = f"\n{blank}\n".join("\n".join(_line(row) for row in group) for group in table.groups)
    parts = [
        f"## {escaped(table.title)}",
        "\n".join([_joined([escaped(text) for text in headings]), _joined(aligned), body]),
    ]
    if table.gaps:
        gaps = [f"- {escaped(line)}" for line in table.gaps]
        parts.append("\n".join(["Missing:", "", *gaps]))
    if table.command:
        parts.append(f"Made by {_code(table.command)}")
    parts.append("\n".join(f"- {escaped(note)}" for note in table.notes))
    return "\n\n".join(parts) + "\n"


def escaped(text: str) -> str:
    """Text that shows as it is written."""
    return SPECIAL.sub(r"\\\1", text)


def _line(row: TableRow) -> str:
    return _joined([*(escaped(text) for text in row.stub), *(_cell(cell) for cell in row.cells)])


def _cell(cell: TableCell) -> str:
    ours = f"**{escaped(cell.ours)}**" if cell.bold else escaped(cell.ours)
    first = f"{ours} {escaped(cell.spread)}".rstrip()
    return f"{first}<br>{escaped(cell.below)}" if cell.below else first


def _joined(texts: Sequence[str]) -> str:
    return f"| {' | '.join(texts)} |"


def _code(text: str) -> str:
    """Verbatim, in a fence of more backticks than the text has in a row."""
    fence = "`" * (1 + max((len(run) for run in re.findall("`+", text)), default=0))
    return f"{fence}{text}{fence}" if fence == "`" else f"{fence} {text} {fence}"

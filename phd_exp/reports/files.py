"""Tables as files: GitHub's Markdown, LaTeX that needs the package booktabs alone, CSV and Parquet."""

import io
import re
from collections.abc import Iterable, Sequence
from functools import partial
from itertools import groupby
from pathlib import Path

import pandas as pd

from phd_exp.evaluation.point_errors import COLUMNS
from phd_exp.records.errors import one_line
from phd_exp.records.written import Written
from phd_exp.reports.kinds import chosen
from phd_exp.reports.paper_tables import paper_tables
from phd_exp.reports.report import Report
from phd_exp.reports.table import Table, TableCell, TableRow
from phd_exp.reports.tables import other_tables

SPECIAL = re.compile(r"([\\`*_\[\]<>#|~&@$])")
"""Characters that GitHub may read as markup, a mention, an issue or mathematics."""
SYMBOLS = {
    "\\": r"\textbackslash{}",
    "~": r"$\sim$",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"\symbol{34}",
    "`": r"\textasciigrave{}",
    "-": r"-{}",  # LaTeX joins two to a dash
    **{letter: f"\\{letter}" for letter in "&%$#_{}"},
    "±": r"$\pm$",
    "°": r"$^\circ$",
    "×": r"$\times$",
    "≥": r"$\geq$",
    "≤": r"$\leq$",
    "↓": r"$\downarrow$",
    "↑": r"$\uparrow$",
    "–": "--",
    "†": r"\textsuperscript{\dag}",
    "‡": r"\textsuperscript{\ddag}",
}


RUNS = (
    "preset data model seed overrides=digest estimate=method reading=subject quantity mean=value low high n_test=n "
    "command git_commit machine"
)


def all_tables(report: Report) -> list[Table]:
    """The paper's tables, and all others for which there are runs; the report notes those that cannot be made."""
    return [*(report.notes.attempt(partial(paper_tables, report), "paper's tables: ") or []), *other_tables(report)]


def write_tables(report: Report, tables: Sequence[Table], out: Path) -> Path:
    """Write the long table, `measured.parquet` and `measured.csv`, and the folder `<out>/tables`, which is returned.

    It has `<stem>.{md,tex}` per table, `<kind>.csv` per kind, and `runs.csv`, a line for every error of every run.
    """
    with Written(out, "measured") as written:
        long = report.long
        long.to_parquet(buffer := io.BytesIO(), index=False)
        written.write("measured.parquet", buffer.getvalue())
        written.write("measured.csv", csv_of(long))
    with Written(out / "tables", "report") as written:
        for table in tables:
            written.write(f"{table.stem}.md", markdown(table))
            written.write(f"{table.stem}.tex", latex(table))
        for kind, alike in groupby(tables, key=lambda table: table.kind):
            written.write(f"{kind}.csv", csv_of(pd.concat([table.lines for table in alike])))
        written.write("runs.csv", csv_of(run_lines(report)))
    return out / "tables"


def run_lines(report: Report) -> pd.DataFrame:
    """A line for every error of every finished run, and one for its NLL, whose interval is not computed."""
    found = report.select(split="test", subject=["whole", "central"], method=[*COLUMNS, "eight views", ""])
    return chosen(found[(found["state"] == "finished") & (found["command"] != "")], RUNS)


def csv_of(lines: pd.DataFrame) -> str:
    """CSV with a line per number, at full precision; missing values are empty."""
    return lines.to_csv(index=False, lineterminator="\n")


def markdown(table: Table) -> str:
    """The table as Markdown: heading, cells, missing runs with the command that makes them, notes.

    Examples:
        >>> from phd_exp.reports.table import Table, TableCell, TableRow
        >>> row = TableRow(("mae_vz",), (TableCell("48", "±3", bold=True),))
        >>> print(markdown(Table("t", "tables", "Depth", ("model",), ("mm",), ((row,),), notes=("95 %",))))
        ## Depth
        <BLANKLINE>
        | model | mm |
        | --- | ---: |
        | mae\\_vz | **48** ±3 |
        <BLANKLINE>
        - 95 %
        <BLANKLINE>
    """
    headings = [*table.stub, *table.columns]
    aligned = ["---"] * len(table.stub) + ["---:"] * len(table.columns)
    blank = "|" + " |" * len(headings)
    body = f"\n{blank}\n".join("\n".join(map(_markdown_line, group)) for group in table.groups)
    parts = [f"## {_plain(table.title)}", "\n".join([_joined(map(_plain, headings)), _joined(aligned), body])]
    if table.gaps:
        parts.append("\n".join(["Missing:", "", *(f"- {_plain(line)}" for line in table.gaps)]))
    if table.command:
        # a fence of more backticks than the command has in a row
        fence = "`" * (1 + max((len(run) for run in re.findall("`+", table.command)), default=0))
        space = "" if fence == "`" else " "
        parts.append(f"Made by {fence}{space}{table.command}{space}{fence}")
    parts.append("\n".join(f"- {_plain(note)}" for note in table.notes))
    return "\n\n".join(parts) + "\n"


def _plain(text: str) -> str:
    """Text without a meaning in Markdown."""
    return SPECIAL.sub(r"\\\1", one_line(text))


def _markdown_line(row: TableRow) -> str:
    return _joined([*map(_plain, row.stub), *map(_markdown_cell, row.cells)])


def _markdown_cell(cell: TableCell) -> str:
    ours = f"**{_plain(cell.ours)}**" if cell.bold else _plain(cell.ours)
    first = f"{ours} {_plain(cell.spread)}".rstrip()
    return f"{first}<br>{_plain(cell.below)}" if cell.below else first


def _joined(texts: Iterable[str]) -> str:
    return f"| {' | '.join(texts)} |"


def latex(table: Table) -> str:
    """The table as an environment for \\input: caption, tabular, missing runs with their command, notes."""
    headings = " & ".join(map(_escaped, (*table.stub, *table.columns)))
    label = re.sub(r"[^A-Za-z0-9-]", "-", table.stem)
    notes = [_escaped(note) for note in table.notes]
    if table.gaps:
        notes += ["Missing:", *map(_escaped, table.gaps)]
    if table.command:
        # straight quotes, so that the command can be copied to a shell
        command = _escaped(table.command).replace("'", r"\textquotesingle{}")
        notes.append(f"Made by \\texttt{{{command}}}")
    return "\n".join(
        [
            f"% {_escaped(table.title)}; needs \\usepackage{{booktabs}}",
            r"\begin{table}",
            r"\centering",
            f"\\caption{{{_escaped(table.title)}}}",
            f"\\label{{tab:{label}}}",
            r"\footnotesize\setlength{\tabcolsep}{2.5pt}",
            f"\\begin{{tabular}}{{@{{}}{'l' * len(table.stub)}{'r' * len(table.columns)}@{{}}}}",
            r"\toprule",
            f"{headings} \\\\",
            r"\midrule",
            "\n\\midrule\n".join(_latex_group(group, table.below) for group in table.groups),
            r"\bottomrule",
            r"\end{tabular}",
            r"\par\medskip",
            r"\begin{minipage}{\linewidth}\footnotesize\raggedright",
            "\\par\n".join(notes),
            r"\end{minipage}",
            r"\end{table}",
            "",
        ]
    )


def _escaped(text: str) -> str:
    """Text without a meaning in LaTeX; letters beyond ASCII, which a font may lack, by their numbers."""
    return "".join(SYMBOLS.get(one) or (one if one.isascii() else f"U+{ord(one):04X}") for one in one_line(text))


def _latex_group(rows: Sequence[TableRow], below: str) -> str:
    """Two lines for a row whose cells have a second line; a label that repeats is printed once."""
    lines = []
    above = ""
    for row in rows:
        label, *rest = row.stub
        lines.append([*map(_escaped, ["" if label == above else label, *rest]), *map(_latex_cell, row.cells)])
        if any(cell.below for cell in row.cells):
            second = [_escaped(cell.below) for cell in row.cells]
            lines.append([*[""] * len(rest), f"\\quad {_escaped(below)}", *second])
        above = label
    return "\n".join(f"{' & '.join(line)} \\\\" for line in lines)


def _latex_cell(cell: TableCell) -> str:
    ours = f"\\textbf{{{_escaped(cell.ours)}}}" if cell.bold else _escaped(cell.ours)
    return f"{ours} {_escaped(cell.spread)}".rstrip()

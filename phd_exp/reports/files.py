"""Tables as files: GitHub's Markdown, LaTeX that needs the package booktabs alone, CSV and Parquet."""

import io
import re
from collections.abc import Sequence
from functools import partial
from itertools import groupby
from pathlib import Path

import pandas as pd
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from phd_exp.evaluation.point_errors import COLUMNS
from phd_exp.records.errors import one_line
from phd_exp.records.written import Written
from phd_exp.reports.kinds import chosen
from phd_exp.reports.paper_tables import paper_tables
from phd_exp.reports.report import Report
from phd_exp.reports.table import Table, TableCell
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
    return _ENVIRONMENT.get_template("table.md").render(table=table, bold=_bold)


def latex(table: Table) -> str:
    """The table as an environment for \\input: caption, tabular, missing runs with their command, notes."""
    notes = [*table.notes, *(["Missing:", *table.gaps] if table.gaps else [])]
    # straight quotes, so that the command can be copied to a shell
    command = _escaped(table.command).replace("'", r"\textquotesingle{}")
    made = [f"Made by \\texttt{{{command}}}"] if command else []
    return _ENVIRONMENT.get_template("table.tex").render(
        table=table, notes=[*map(_escaped, notes), *made], bold=_bold
    )


def _bold(cell: TableCell, before: str, after: str, text: str) -> str:
    return f"{before}{text}{after}" if cell.bold else text


def _plain(text: str) -> str:
    """Text without a meaning in Markdown."""
    return SPECIAL.sub(r"\\\1", one_line(text))


def _code(text: str) -> str:
    """Code of Markdown, between more backticks than the text has in a row."""
    fence = "`" * (1 + max(map(len, re.findall("`+", text)), default=0))
    space = "" if fence == "`" else " "
    return f"{fence}{space}{text}{space}{fence}"


def _escaped(text: str) -> str:
    """Text without a meaning in LaTeX; letters beyond ASCII, which a font may lack, by their numbers."""
    return "".join(SYMBOLS.get(one) or (one if one.isascii() else f"U+{ord(one):04X}") for one in one_line(text))


_ENVIRONMENT = Environment(
    loader=FileSystemLoader(Path(__file__).parent / "templates"),
    autoescape=False,  # Markdown and LaTeX have their own filters
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
    comment_start_string="<#",
    comment_end_string="#>",
)
_ENVIRONMENT.filters |= {
    "md": _plain,
    "code": _code,
    "tex": _escaped,
    "label": lambda stem: re.sub(r"[^A-Za-z0-9-]", "-", stem),
}

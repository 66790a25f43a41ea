"""Tables as files: GitHub's Markdown, LaTeX that needs the package booktabs alone, and CSV."""

import csv
import io
import re
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

from phd_exp.records.choices import PLAIN_RECIPE, preset_and_recipe
from phd_exp.records.errors import one_line
from phd_exp.records.written import Written
from phd_exp.reports.calibration_table import calibration_tables
from phd_exp.reports.cells import interval
from phd_exp.reports.ensembles import ensemble_tables
from phd_exp.reports.fusion import fusion_tables
from phd_exp.reports.heads_table import heads_tables
from phd_exp.reports.paper_tables import paper_tables
from phd_exp.reports.runs import Report, Run
from phd_exp.reports.searches import search_tables
from phd_exp.reports.shift_tables import shift_tables
from phd_exp.reports.table import Table, TableCell, TableRow, bounds
from phd_exp.reports.tracks import tracks_tables
from phd_exp.reports.variations import variation_tables

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


def all_tables(report: Report) -> list[Table]:
    """The paper's tables, and all others for which there are runs; the report notes those that cannot be made."""
    makers = (
        paper_tables,
        heads_tables,
        calibration_tables,
        ensemble_tables,
        shift_tables,
        variation_tables,
        fusion_tables,
        tracks_tables,
        search_tables,
    )
    found = (report.notes.attempt(partial(make, report), f"{make.__name__}: ") or [] for make in makers)
    return [table for tables in found for table in tables]


def write_tables(report: Report, tables: Sequence[Table], out: Path) -> Path:
    """Write `<stem>.{md,tex}` per table, `<kind>.csv` per kind and `runs.csv`; returns the folder, `<out>/tables`."""
    with Written(out / "tables", "report") as written:
        for table in tables:
            written.write(f"{table.stem}.md", markdown(table))
            written.write(f"{table.stem}.tex", latex(table))
        for kind, alike in groupby(tables, key=lambda table: table.kind):
            written.write(f"{kind}.csv", tidy([line for table in alike for line in table.numbers]))
        written.write("runs.csv", tidy(run_lines(report)))
    return out / "tables"


def run_lines(report: Report) -> list[dict[str, Any]]:
    """A line for every error of every finished run, and one for its NLL, whose interval is not computed."""
    return [
        run.choice
        | {"seed": run.seed, "overrides": run.digest}
        | number
        | {"command": command_of(run), "git_commit": run.status.git_commit, "machine": run.status.machine}
        for run in report.runs
        if run.state == "finished" and run.status
        for number in _numbers(run)
    ]


def _numbers(run: Run) -> Iterator[dict[str, Any]]:
    for key, mean in run.errors.items():
        name = {"estimate": key.estimate, "reading": key.reading, "quantity": f"{key.quantity}_error_mm"}
        yield name | {"mean": mean.value, **bounds(interval([mean])), "n_test": mean.n}
    if run.nll is not None:
        n = max(mean.n for mean in run.errors.values())
        name = {"estimate": "", "reading": "whole", "quantity": "nll"}
        yield name | {"mean": run.nll, **bounds(None), "n_test": n}


def command_of(run: Run) -> str:
    """The command line that makes a run."""
    preset, recipe = preset_and_recipe(run.preset)
    words = [f"preset={preset}", f"data={run.data}", f"model={run.model}", f"seed={run.seed}"]
    words += [f"recipe={recipe}"] if recipe != PLAIN_RECIPE else []
    words += run.status.overrides if run.status else []
    return one_line(shlex.join(["python", "-m", "phd_exp", *words]))


def tidy(numbers: Sequence[Mapping[str, Any]]) -> str:
    """CSV with a line per number, at full precision; missing values are empty."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, list(numbers[0]) if numbers else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows({key: one_line(v) if isinstance(v, str) else v for key, v in line.items()} for line in numbers)
    return stream.getvalue()


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

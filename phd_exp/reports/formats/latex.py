"""Tables as LaTeX: a `table` environment that needs the package booktabs and nothing else."""

import re
from collections.abc import Sequence

from phd_exp.reports.table import Table, TableCell, TableRow

SYMBOLS = {
    "\\": r"\textbackslash{}",
    "~": r"$\sim$",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"\symbol{34}",
    "`": r"\textasciigrave{}",
    "-": r"-{}",  # two in a row would join to a dash
    **{letter: f"\\{letter}" for letter in "&%$#_{}"},
    "±": r"$\pm$",
    "°": r"$^\circ$",
    "×": r"$\times$",
    "≥": r"$\geq$",
    "≤": r"$\leq$",
    "–": "--",
    "†": r"\textsuperscript{\dag}",
    "‡": r"\textsuperscript{\ddag}",
}


def latex(table: Table) -> str:
    """The environment, to be read by \\input: caption, tabular, what it lacks, how to read it."""
    stub, columns = len(table.stub), len(table.columns)
    headings = " & ".join(escaped(text) for text in (*table.stub, *table.columns))
    body = "\n\\midrule\n".join(_group(group, table.below) for group in table.groups)
    return "\n".join(
        [
            f"% {escaped(table.title)}; needs \\usepackage{{booktabs}}",
            r"\begin{table}",
            r"\centering",
            f"\\caption{{{escaped(table.title)}}}",
            f"\\label{{tab:{_label(table)}}}",
            r"\footnotesize\setlength{\tabcolsep}{2.5pt}",
            f"\\begin{{tabular}}{{@{{}}{'l' * stub}{'r' * columns}@{{}}}}",
            r"\toprule",
            f"{headings} \\\\",
            r"\midrule",
            body,
            r"\bottomrule",
            r"\end{tabular}",
            *_below(table),
            r"\end{table}",
            "",
        ]
    )


def escaped(text: str) -> str:
    """Text that prints as it is written; letters beyond ASCII, which a font may lack, by their numbers."""
    return "".join(
        SYMBOLS.get(letter) or (letter if letter.isascii() else _number(letter)) for letter in text
    )


def _number(letter: str) -> str:
    return f"U+{ord(letter):04X}"


def _group(rows: Sequence[TableRow], below: str) -> str:
    lines: list[list[str]] = []
    above = ""
    for row in rows:
        label, *rest = row.stub
        lines.append(["" if label == above else label, *rest])
        above = label
    return "\n".join(_lines(stub, row, below) for stub, row in zip(lines, rows, strict=True))


def _lines(stub: Sequence[str], row: TableRow, below: str) -> str:
    """Ours, and below it the second lines where a cell has one."""
    lines = [[*(escaped(text) for text in stub), *(_ours(cell) for cell in row.cells)]]
    if any(cell.below for cell in row.cells):
        left = [""] * (len(stub) - 1)
        lines.append([*left, f"\\quad {escaped(below)}", *(escaped(cell.below) for cell in row.cells)])
    return "\n".join(f"{' & '.join(line)} \\\\" for line in lines)


def _ours(cell: TableCell) -> str:
    ours = f"\\textbf{{{escaped(cell.ours)}}}" if cell.bold else escaped(cell.ours)
    return f"{ours} {escaped(cell.spread)}".rstrip()


def _below(table: Table) -> list[str]:
    lines = [escaped(note) for note in table.notes]
    if table.gaps:
        lines += ["Missing:", *(escaped(line) for line in table.gaps)]
    if table.command:
        lines.append(f"Made by {_code(table.command)}")
    return [
        r"\par\medskip",
        r"\begin{minipage}{\linewidth}\footnotesize\raggedright",
        "\\par\n".join(lines),
        r"\end{minipage}",
    ]


def _code(text: str) -> str:
    # what a reader may copy to a shell: quotes must stay straight
    straight = escaped(text).replace("'", r"\textquotesingle{}")
    return f"\\texttt{{{straight}}}"


def _label(table: Table) -> str:
    return re.sub(r"[^A-Za-z0-9-]", "-", table.stem)

"""Tables as LaTeX: a `table` environment that needs the package booktabs and nothing else."""

import re

from phd_exp.reports.tables import PaperTable, TableCell, TableRow, gap_lines

SYMBOLS = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"\symbol{34}",
    "'": r"\textquotesingle{}",
    "`": r"\textasciigrave{}",
    "-": r"-{}",  # two in a row would join to a dash
    **{letter: f"\\{letter}" for letter in "&%$#_{}"},
    "±": r"$\pm$",
    "×": r"$\times$",
    "≥": r"$\geq$",
    "≤": r"$\leq$",
    "–": "--",
    "†": r"\textsuperscript{\dag}",
    "‡": r"\textsuperscript{\ddag}",
}


def latex(table: PaperTable) -> str:
    """The environment, to be read by \\input: caption, tabular, what it lacks, how to read it."""
    stub, columns = len(table.stub), len(table.columns)
    headings = " & ".join(escaped(text) for text in (*table.stub, *table.columns))
    body = "\n\\midrule\n".join("\n".join(_lines(row) for row in group) for group in table.groups)
    return "\n".join(
        [
            f"% {escaped(table.title)}; needs \\usepackage{{booktabs}}",
            r"\begin{table}",
            r"\centering",
            f"\\caption{{{escaped(table.title)}}}",
            f"\\label{{tab:{_label(table)}}}",
            r"\small",
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


def _lines(row: TableRow) -> str:
    """Ours, and below it the paper's figure where one cell has it."""
    lines = [[*(escaped(text) for text in row.stub), *(_ours(cell) for cell in row.cells)]]
    if any(cell.paper for cell in row.cells):
        words = ["paper (ratio)", *[""] * (len(row.stub) - 1)]
        lines.append([f"\\quad {words[0]}", *words[1:], *(escaped(cell.paper) for cell in row.cells)])
    return "\n".join(f"{' & '.join(line)} \\\\" for line in lines)


def _ours(cell: TableCell) -> str:
    ours = f"\\textbf{{{escaped(cell.ours)}}}" if cell.bold else escaped(cell.ours)
    return f"{ours} {escaped(cell.spread)}".rstrip()


def _below(table: PaperTable) -> list[str]:
    lines = [escaped(note) for note in table.notes]
    if table.gaps:
        lines += ["Not there:", *(escaped(line) for line in gap_lines(table.gaps))]
        lines.append(f"Made by \\texttt{{{escaped(table.command)}}}")
    return [
        r"\par\medskip",
        r"\begin{minipage}{\linewidth}\footnotesize\sloppy",
        "\\par\n".join(lines),
        r"\end{minipage}",
    ]


def _label(table: PaperTable) -> str:
    return re.sub(r"[^A-Za-z0-9-]", "-", f"{table.name}-{table.preset}-{table.reading}")

"""Tables in the terminal, and the list of all runs."""

from collections.abc import Sequence
from itertools import groupby

from rich import box
from rich.console import Console
from rich.table import Table as Grid
from rich.text import Text

from phd_exp.evaluation.point_errors import ErrorKey, Quantity
from phd_exp.records.errors import one_line
from phd_exp.reports.paper_tables import DIGITS, making_command
from phd_exp.reports.runs import Report, Run
from phd_exp.reports.table import NOTHING, Table, TableCell

WIDTH = 118  # columns, also if the output is not a terminal and rich would fall back to 80
TONES = {"": "", "off": "yellow", "broken": "red"}
OF_A_STAR = "* marks numbers that a terminal prints in bold."


def print_report(report: Report, tables: Sequence[Table]) -> None:
    """Print all tables except details, missing runs, notes, and every run with its state."""
    console = Console(width=max(WIDTH, Console().width), highlight=False, markup=False, emoji=False)
    starred = not console.is_terminal
    tables = [table for table in tables if table.reading != "details"]
    for table in tables:
        _print(console, table.title, style="bold")
        console.print(_grid(table, starred))
        console.print()
    with_command = [table for table in tables if table.command]
    for command, alike in groupby(with_command, key=lambda table: table.command):
        for line in dict.fromkeys(line for table in alike for line in table.gaps):
            _print(console, f"Missing: {line}")
        _print_command(console, "Made by", command)
    for note in dict.fromkeys(note for table in tables for note in table.notes):
        _print(console, note)
    if starred and any(cell.bold for table in tables for row in table.rows for cell in row.cells):
        _print(console, OF_A_STAR)
    if tables:
        console.print()
    _print_runs(console, report.runs)
    if not any(table.kind == "tables" for table in tables):
        state = "no run of a table yet" if report.runs else "no runs recorded yet"
        _print_command(console, f"{state}; begin by", making_command(report, "paper", "table1"))


def _print_runs(console: Console, runs: Sequence[Run]) -> None:
    plain = [run for run in runs if run.overrides is None]
    apart = [run for run in runs if run.overrides is not None]
    for title, chosen in (("Runs", plain), ("Runs with other overrides, in no table of the paper", apart)):
        if chosen:
            _print(console, f"{title}; projected and depth error in mm, NLL in nats", style="bold")
            console.print(_run_list(chosen))
            console.print()


def _text(text: str, style: str = "", no_wrap: bool = False) -> Text:
    """A text that may come from a record: no markup, and nothing that controls the terminal."""
    return Text(one_line(text), style=style, no_wrap=no_wrap)


def _print(console: Console, text: str, style: str = "") -> None:
    console.print(_text(text, style))


def _print_command(console: Console, before: str, command: str) -> None:
    console.print(_text(f"{before}: {command}"), soft_wrap=True)  # on one line, to be copied


def _grid(table: Table, starred: bool) -> Grid:
    """The table drawn by rich; significantly best numbers are bold, and starred if the output has no bold."""
    grid = Grid(box=box.SIMPLE_HEAD, show_edge=False)
    for heading in table.stub:
        grid.add_column(_text(heading), overflow="fold", min_width=12)
    for heading in table.columns:
        grid.add_column(_text(heading), justify="right")
    for group in table.groups:
        for row in group:
            cells = [*map(_text, row.stub), *(_cell(cell, starred) for cell in row.cells)]
            grid.add_row(*cells, end_section=row is group[-1])
    return grid


def _cell(cell: TableCell, starred: bool) -> Text:
    text = _text("*" if cell.bold and starred else "", TONES[cell.tone], no_wrap=True)
    text.append(_text(cell.ours, "bold" if cell.bold else ""))
    if cell.spread:
        text.append(" ").append(_text(cell.spread))
    if cell.below:
        text.append("\n").append(_text(cell.below, "dim"))
    return text


def _run_list(runs: Sequence[Run]) -> Grid:
    grid = Grid(box=box.SIMPLE_HEAD, show_edge=False)
    grid.add_column("run", overflow="fold")
    for heading in ("projected", "depth", "NLL"):
        grid.add_column(heading, justify="right", no_wrap=True)
    grid.add_column("state", overflow="fold")
    for run in runs:
        nll = NOTHING if run.nll is None else f"{run.nll:.2f}"
        grid.add_row(_text(run.path), _error(run, "projected"), _error(run, "depth"), nll, _text(_state(run)))
    return grid


def _error(run: Run, quantity: Quantity) -> str:
    mean = run.errors.get(ErrorKey("mode", "whole", quantity))
    return NOTHING if mean is None else f"{mean.value:.{DIGITS[quantity]}f}"


def _state(run: Run) -> str:
    words = f"{run.state}: {run.detail}" if run.detail else run.state
    apart = "" if run.overrides is None else f"; overrides: {run.overrides}"
    return words + apart

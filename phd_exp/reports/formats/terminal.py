"""Tables for the terminal, and the list of all runs."""

from collections.abc import Sequence
from itertools import groupby

from rich import box
from rich.console import Console
from rich.padding import Padding
from rich.table import Table as Grid
from rich.text import Text

from phd_exp.evaluation.point_errors import ErrorKey, Quantity
from phd_exp.records.errors import one_line
from phd_exp.reports.paper_tables import DIGITS, making_command
from phd_exp.reports.runs import Report, Run
from phd_exp.reports.table import NOTHING, Table, TableCell

WIDTH = 118
"""Columns, also where the output is no terminal and rich would fall back to 80."""
OF_A_STAR = "* marks what a terminal shows in bold."


def print_report(report: Report, tables: Sequence[Table]) -> None:
    """Print all tables, what they lack, how to read them, and every run with its state."""
    console = _console()
    for table in tables:
        _say(console, table.title, style="bold")
        console.print(_drawn(table, starred=not console.is_terminal))
        console.print()
    for command, alike in groupby(
        (table for table in tables if table.command), key=lambda table: table.command
    ):
        for line in dict.fromkeys(line for table in alike for line in table.gaps):
            _say(console, f"Missing: {line}")
        _say_command(console, "Made by", command)
    for note in dict.fromkeys(note for table in tables for note in table.notes):
        _say(console, note)
    cells = (cell for table in tables for group in table.groups for row in group for cell in row.cells)
    if not console.is_terminal and any(cell.bold for cell in cells):
        _say(console, OF_A_STAR)
    if tables:
        console.print()
    _print_runs(console, report.runs)
    if not any(table.kind == "tables" for table in tables):
        what = "no run of a table yet" if report.runs else "no runs recorded yet"
        _say_command(console, f"{what}; begin by", making_command(report, "paper", "table1"))


def _console() -> Console:
    return Console(width=max(WIDTH, Console().width), highlight=False)


def _print_runs(console: Console, runs: Sequence[Run]) -> None:
    plain = [run for run in runs if run.overrides is None]
    apart = [run for run in runs if run.overrides is not None]
    for title, chosen in (("Runs", plain), ("Runs with other overrides, in no table of the paper", apart)):
        if chosen:
            _say(console, f"{title}; projected and depth error in mm, NLL in nats", style="bold")
            console.print(_run_list(chosen))
            console.print()


def _say(console: Console, text: str, style: str = "", left: int = 0) -> None:
    # Text, not str: square brackets from a file are no markup
    console.print(Padding(Text(text, style=style), (0, 0, 0, left), expand=False))


def _say_command(console: Console, before: str, command: str) -> None:
    console.print(Text(f"{before}: {command}"), soft_wrap=True)  # what is copied must not be broken


def _drawn(table: Table, *, starred: bool) -> Grid:
    """As rich draws it; the best are bold, and starred where the output shows no bold."""
    drawn = Grid(box=box.SIMPLE_HEAD, show_edge=False)
    for heading in table.stub:
        drawn.add_column(heading, overflow="fold", min_width=12)
    for heading in table.columns:
        drawn.add_column(heading, justify="right", no_wrap=True)
    for group in table.groups:
        for row in group:
            stub = [Text(text) for text in row.stub]
            drawn.add_row(*stub, *(_cell(cell, starred) for cell in row.cells), end_section=row is group[-1])
    return drawn


def _cell(cell: TableCell, starred: bool) -> Text:
    text = Text("*" if cell.bold and starred else "")
    text.append(cell.ours, style="bold" if cell.bold else "")
    if cell.spread:
        text.append(f" {cell.spread}")
    if cell.below:
        text.append(f"\n{cell.below}", style="dim")
    return text


def _run_list(runs: Sequence[Run]) -> Grid:
    drawn = Grid(box=box.SIMPLE_HEAD, show_edge=False)
    drawn.add_column("run", overflow="fold")
    for heading in ("projected", "depth", "NLL"):
        drawn.add_column(heading, justify="right", no_wrap=True)
    drawn.add_column("state", overflow="fold")
    for run in runs:
        drawn.add_row(
            Text(run.path),
            _error(run, "projected"),
            _error(run, "depth"),
            NOTHING if run.nll is None else f"{run.nll:.2f}",
            Text(_state(run)),
        )
    return drawn


def _error(run: Run, quantity: Quantity) -> str:
    mean = run.errors.get(ErrorKey("mode", "whole", quantity))
    return NOTHING if mean is None else f"{mean.value:.{DIGITS[quantity]}f}"


def _state(run: Run) -> str:
    words = f"{run.state}: {run.detail}" if run.detail else run.state
    apart = "" if run.overrides is None else f"; overrides: {run.overrides}"
    return one_line(words + apart)

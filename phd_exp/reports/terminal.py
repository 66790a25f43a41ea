"""Tables in the terminal, and the list of all runs: one screen."""

from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.table import Table as Grid
from rich.text import Text

from phd_exp.records.errors import one_line
from phd_exp.reports.paper_tables import making_command
from phd_exp.reports.quantities import SCORES
from phd_exp.reports.report import Report
from phd_exp.reports.table import Table, TableCell

WIDTH = 118  # columns, also if the output is not a terminal and rich would fall back to 80
MOST, FEWEST_RUNS = 54, 12
"""Lines of tables and runs, and the runs that are listed whatever tables there are."""
LONGEST = 30  # letters of a state
TONES = {"": "", "off": "yellow", "broken": "red"}
SHOWN = {"projected_error_mm": "projected (mm)", "depth_error_mm": "depth (mm)", "nll": "NLL"}


def print_report(report: Report, tables: Sequence[Table]) -> None:
    """Print the tables that fit on a screen, without details and notes, and the runs with their states.

    Runs that have not finished come first. A star marks bold numbers where the output has no bold.
    """
    console = Console(width=max(WIDTH, Console().width), highlight=False, markup=False, emoji=False)
    left = MOST - min(len(report.runs), FEWEST_RUNS) - 4
    found = [table for table in tables if table.reading != "details"]
    more = 0
    for table in sorted(found, key=lambda table: table.reading == "central"):
        with console.capture() as captured:
            console.print(_text(table.title, "bold"), _grid(table, starred=not console.is_terminal), sep="\n")
        if (lines := captured.get().count("\n") + 1) <= left:
            console.out(captured.get(), highlight=False)
            left -= lines
        else:
            more += 1
    if report.runs:
        _print_runs(console, report, FEWEST_RUNS + max(left, 0))
    else:
        command = making_command(report, "paper", "table1")
        console.print(
            _text(f"no runs recorded yet; begin by: {command}"), soft_wrap=True
        )  # on one line, to be copied
    if more:
        console.print(f"{more} further table{'s' if more > 1 else ''}: on the pages and in the files")


def _text(text: str, style: str = "", no_wrap: bool = False) -> Text:
    """A text that may come from a record: no markup, and nothing that controls the terminal."""
    return Text(one_line(text), style=style, no_wrap=no_wrap)


def _grid(table: Table, starred: bool) -> Grid:
    """The table drawn by rich."""
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


def _print_runs(console: Console, report: Report, most: int) -> None:
    """The list of runs: their errors and NLL on the test images, and their states."""
    grid = Grid(box=box.SIMPLE_HEAD, show_edge=False)
    grid.add_column("run", overflow="fold")
    for heading in SHOWN.values():
        grid.add_column(heading, justify="right", no_wrap=True)
    grid.add_column("state")
    found = report.select(split="test", subject="whole", method=["mode", ""])
    values = {
        (path, name): value
        for path, name, value in zip(found["path"], found["quantity"], found["value"], strict=True)
    }
    runs = report.facts.sort_values("state", key=lambda state: state == "finished", kind="stable")
    for run in runs.head(most).itertuples():
        numbers = (SCORES[name].text(values.get((run.path, name))) for name in SHOWN)
        words = one_line(": ".join(filter(None, (run.state, run.detail, run.words))))
        short = words if len(words) <= LONGEST else f"{words[: LONGEST - 1]}…"
        grid.add_row(_text(run.path), *numbers, _text(short))
    console.print(grid)
    if len(runs) > most:
        console.print(f"and {len(runs) - most} further finished runs")

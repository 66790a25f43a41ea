"""Tables for the terminal."""

from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.table import Table

from phd_exp.reports.collect import RunRow

WIDTH = 118
"""Columns, also where the output is no terminal and rich would fall back to 80."""


def print_table(rows: Sequence[RunRow]) -> None:
    """Print all runs beside the paper's numbers."""
    console = Console(width=max(WIDTH, Console().width))
    if not rows:
        console.print("no runs recorded yet")
        return
    console.print(_table(rows))
    console.print(
        "Errors in millimetres on the test split; [dim]paper[/dim]: 50 epochs of ResNet-50 on 8000 images, 2000 "
        "test images. NLL in nats.",
        highlight=False,
    )


def _table(rows: Sequence[RunRow]) -> Table:
    table = Table(box=box.SIMPLE_HEAD)
    for name in ("preset", "data", "model", "run"):
        table.add_column(name, no_wrap=True)
    for name, style in (("projected", ""), ("paper", "dim"), ("depth", ""), ("paper", "dim"), ("NLL", "")):
        table.add_column(name, style=style, justify="right", no_wrap=True)
    table.add_column("state")
    for row in rows:
        published = row.published
        table.add_row(
            row.preset,
            row.data,
            row.model,
            row.run,
            _number(row.projected_error_mm, 1),
            _number(published.projected_error_mm if published else None, 1),
            _number(row.depth_error_mm, 0),
            _number(published.depth_error_mm if published else None, 0),
            _number(row.nll, 2),
            row.state,
        )
    return table


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"

"""Progress of rendering: a bar in a terminal, a line every ten seconds elsewhere."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

from phd_exp.records.processes import announce, duration

SECONDS_BETWEEN_LINES = 10.0


class _Speed(TextColumn):
    """Images per second over the last minute."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text(f"{speed:.1f} images/s" if speed else "starting")


@contextmanager
def shown_progress(total: int, title: str) -> Iterator[Callable[[], None]]:
    """Show the progress of a task on `total` images; yields a function to call after each image."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield _lines(total, title)
        return
    columns = (TextColumn(title), BarColumn(), MofNCompleteColumn(), _Speed(""), TimeRemainingColumn())
    with Progress(*columns, console=console, speed_estimate_period=60) as progress:
        bar = progress.add_task(title, total=total)
        yield lambda: progress.advance(bar)


def _lines(total: int, title: str) -> Callable[[], None]:
    """Print a line every ten seconds and one at the end, which log files can hold.

    The rate counts from the first image, because Blender and its scene start before it.
    """
    done, first, printed = 0, math.inf, time.monotonic()

    def advance() -> None:
        nonlocal done, first, printed
        done, now = done + 1, time.monotonic()
        first = min(first, now)
        if done >= total or (done > 1 and now - printed >= SECONDS_BETWEEN_LINES):
            printed = now
            speed = (done - 1) / max(now - first, 1e-9)
            rate = f", {speed:.1f} images/s, {duration((total - done) / speed)} left" if speed else ""
            announce(f"{title}: {done}/{total} images{rate}")

    return advance

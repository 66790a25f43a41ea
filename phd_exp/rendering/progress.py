"""Progress of rendering: a bar in a terminal, a line every ten seconds elsewhere."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from phd_exp.records.processes import announce, duration

SECONDS_BETWEEN_LINES = 10.0
FEWEST, PATIENCE = 8, 5.0  # images, and seconds from the first of them, before the first forecast
LONG = 600.0  # s, of which more are announced with a smaller choice


@contextmanager
def shown_progress(total: int, title: str, remedy: str = "") -> Iterator[Callable[[], None]]:
    """Show the progress of a task on `total` images; yields a function to call after each image.

    The speed is that of the last minutes; Blender's start does not count. If the first forecast is long, a line says
    so, and names a remedy if there is one.
    """
    console = Console(stderr=True)
    columns = (TextColumn(title), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[words]}"))
    options = {"disable": not console.is_terminal, "speed_estimate_period": 120.0, "get_time": time.monotonic}
    with Progress(*columns, console=console, **options) as bars:  # type: ignore[arg-type]
        bars.add_task(title, total=total, words="starting")
        (task,) = bars.tasks
        first, printed, is_long = 0.0, time.monotonic(), False

        def advance() -> None:
            nonlocal first, printed, is_long
            bars.advance(task.id)
            now, done = time.monotonic(), int(task.completed)
            first = first or now
            left, words = task.time_remaining, ""
            if task.speed and (done == total or (done >= FEWEST and now - first >= PATIENCE)):
                words = f"{task.speed:.1f} images/s" + f", about {duration(left or 0)} left" * (done < total)
                if remedy and not is_long and (left or 0) > LONG:
                    is_long = True
                    announce(f"about {duration(left or 0)} left; {remedy}")
            bars.update(task.id, words=words or "measuring")
            is_due = words and now - printed >= SECONDS_BETWEEN_LINES
            if not console.is_terminal and (is_due or done == total):
                printed = now
                announce(f"{title}: {done}/{total} images{words and ', '}{words}")

        yield advance

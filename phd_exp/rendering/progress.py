"""Progress of rendering: a bar in a terminal, a line every ten seconds elsewhere."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from phd_exp.records.processes import announce, duration

SECONDS_BETWEEN_LINES = 10.0
PATIENCE = 5.0  # s from the first image to the first forecast
FEWEST = 3  # images of each process before the first forecast
LONG = 600.0  # s, of which more are announced with a smaller choice


class Forecast:
    """Counts images and predicts the time left from their mean speed, once it is measured.

    Blender's start and each process's first image, for which it loads the scene, do not count.
    """

    def __init__(self, total: int, processes: int) -> None:
        self.total, self.processes, self.done = total, processes, 0
        self._first = 0.0
        self.left: float | None = None
        """Seconds until all images are done, if it is known."""

    def count(self) -> str:
        """Count one more image; returns the speed and the time left in words, empty if too few are done."""
        now, self.done = time.monotonic(), self.done + 1
        if self.done == self.processes:
            self._first = now
        counted, seconds = self.done - self.processes, now - self._first
        is_early = counted < FEWEST * self.processes or seconds < PATIENCE
        if counted <= 0 or seconds <= 0 or (is_early and self.done < self.total):
            return ""
        self.left = (self.total - self.done) * seconds / counted
        left = f", about {duration(self.left)} left" if self.done < self.total else ""
        return f"{counted / seconds:.1f} images/s{left}"


@contextmanager
def shown_progress(total: int, title: str, processes: int = 1, remedy: str = "") -> Iterator[Callable[[], None]]:
    """Show the progress of a task on `total` images; yields a function to call after each image.

    If the first forecast is long, a line says so, and names a remedy if there is one.
    """
    console, forecast = Console(stderr=True), Forecast(total, processes)
    columns = (TextColumn(title), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[words]}"))
    with Progress(*columns, console=console, disable=not console.is_terminal) as bars:
        bar, printed = bars.add_task(title, total=total, words="starting"), time.monotonic()

        def advance() -> None:
            nonlocal printed
            is_first, words, now = forecast.left is None, forecast.count(), time.monotonic()
            if is_first and remedy and (forecast.left or 0) > LONG:
                announce(f"about {duration(forecast.left or 0)} left; {remedy}")
            bars.update(bar, completed=forecast.done, words=words or "measuring")
            is_due = words and now - printed >= SECONDS_BETWEEN_LINES
            if not console.is_terminal and (is_due or forecast.done == total):
                printed = now
                announce(f"{title}: {forecast.done}/{total} images{words and ', '}{words}")

        yield advance

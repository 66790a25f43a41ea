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
        self._first = self._last = 0.0

    def count(self) -> None:
        """One more image is done."""
        self.done, self._last = self.done + 1, time.monotonic()
        if self.done == self.processes:
            self._first = self._last

    @property
    def speed(self) -> float | None:
        """Images a second; None if too few are done."""
        counted, seconds = self.done - self.processes, self._last - self._first
        is_early = counted < FEWEST * self.processes or seconds < PATIENCE
        if counted <= 0 or seconds <= 0 or (is_early and self.done < self.total):
            return None
        return counted / seconds

    @property
    def left(self) -> float | None:
        """Seconds until all images are done, or None."""
        return (self.total - self.done) / self.speed if self.speed else None

    def __str__(self) -> str:
        if self.speed is None or self.left is None:
            return ""
        left = f", about {duration(self.left)} left" if self.done < self.total else ""
        return f"{self.speed:.1f} images/s{left}"


@contextmanager
def shown_progress(total: int, title: str, processes: int = 1, remedy: str = "") -> Iterator[Callable[[], None]]:
    """Show the progress of a task on `total` images; yields a function to call after each image.

    If the first forecast is long, a line says so, and names a remedy if there is one.
    """
    console, forecast = Console(stderr=True), Forecast(total, processes)
    if not console.is_terminal:
        show = _lines(title, forecast)
        yield _counting(forecast, show, remedy)
        return
    columns = (TextColumn(title), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[words]}"))
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task(title, total=total, words="starting")
        yield _counting(
            forecast,
            lambda: progress.update(bar, completed=forecast.done, words=str(forecast) or "measuring"),
            remedy,
        )


def _counting(forecast: Forecast, show: Callable[[], None], remedy: str) -> Callable[[], None]:
    """The function to call after each image."""
    is_new = True

    def advance() -> None:
        nonlocal is_new
        forecast.count()
        if is_new and forecast.left is not None:
            is_new = False
            if forecast.left > LONG and remedy:
                announce(f"about {duration(forecast.left)} left; {remedy}")
        show()

    return advance


def _lines(title: str, forecast: Forecast) -> Callable[[], None]:
    """Print a line every ten seconds and one at the end, which log files can hold."""
    printed = time.monotonic()

    def show() -> None:
        nonlocal printed
        now, words = time.monotonic(), str(forecast)
        if forecast.done == forecast.total or (words and now - printed >= SECONDS_BETWEEN_LINES):
            printed = now
            announce(f"{title}: {forecast.done}/{forecast.total} images{words and ', '}{words}")

    return show

"""What a person sees while images are rendered: a bar in a terminal, a line now and then elsewhere."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

SECONDS_BETWEEN_LINES = 10.0

Advance = Callable[[], None]


class _Speed(TextColumn):
    """Images a second over the last minute or so."""

    def __init__(self) -> None:
        super().__init__("")

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text(f"{speed:.1f} images/s" if speed else "starting")


def announce(message: str) -> None:
    """One line to standard error, in a terminal or not."""
    print(message, file=sys.stderr, flush=True)


@contextmanager
def shown_progress(total: int, title: str) -> Iterator[Advance]:
    """Show how far a work of `total` images is; the body calls what it is given once per finished image."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield _Lines(total, title)
        return
    columns = (TextColumn(title), BarColumn(), MofNCompleteColumn(), _Speed(), TimeRemainingColumn())
    with Progress(*columns, console=console, speed_estimate_period=60) as progress:
        bar = progress.add_task(title, total=total)
        yield lambda: progress.advance(bar)


class _Lines:
    """A line every ten seconds and one at the end: readable in a log file."""

    def __init__(self, total: int, title: str) -> None:
        self._total, self._title = total, title
        self._done = 0
        self._begun = self._told = time.monotonic()

    def __call__(self) -> None:
        self._done += 1
        now = time.monotonic()
        if now - self._told < SECONDS_BETWEEN_LINES and self._done < self._total:
            return
        self._told = now
        speed = self._done / max(now - self._begun, 1e-9)
        left = (self._total - self._done) / speed
        announce(f"{self._title}: {self._done}/{self._total} images, {speed:.1f} images/s, {left:.0f} s left")

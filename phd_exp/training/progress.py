"""Progress of a training: one bar on a terminal, elsewhere a line about every tenth of the run."""

import math
import sys
import time
from collections.abc import Sequence
from functools import partial
from typing import Any

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.utilities import rank_zero_only
from rich.console import Console
from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as Bars

from phd_exp.records.processes import duration
from phd_exp.training.recorder import epoch_metrics

LINES = 10  # of a training, about
PATIENCE = 5.0  # s from the first batch to the first line, and at least between lines within an epoch
FEWEST, LONGEST = 10, 30.0  # batches after the first one, or seconds, before the first line
LONG = 600.0  # s left, of which more are announced with a smaller choice
SMALLER = {"paper": "preset=small", "full": "preset=small", "small": "preset=demo"}
BETWEEN_LOOKS = 0.5  # s between two readings of the loss, which a GPU would have to wait for
SHOWN = ("test/loss", "test/projected_error_mm", "test/depth_error_mm")


class Progress(Callback):
    """Shows the epoch, from 1, the loss, the errors of the last evaluation, and the time left.

    Args:
        is_terminal: whether to draw a bar on standard error; otherwise lines go to standard output.
        preset: if the first estimate of the time left is long, a line names a smaller one.
    """

    def __init__(self, is_terminal: bool, preset: str = "") -> None:
        self.bar = _Bar() if is_terminal else None
        self.smaller = SMALLER.get(preset, "")
        self.say = rank_zero_only(partial(print, flush=True))

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        epochs = trainer.max_epochs or 1
        self.errors: list[str] = []
        self.epochs = line_epochs(epochs, trainer.check_val_every_n_epoch or 1)
        self._start(trainer, _epoch(trainer), epochs * int(trainer.num_training_batches), epochs <= LINES)

    def on_predict_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._start(trainer, "evaluation", int(trainer.num_predict_batches[0]), True, stays=False)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        n = int(trainer.num_training_batches)
        is_due, self.loss = self._count(trainer.current_epoch * n + batch_idx + 1), outputs["loss"]
        if is_due and self.smaller:
            self._name_smaller()
        if self.bar and is_due:
            self.bar.show(_epoch(trainer), self.done, self._words())
        elif is_due and batch_idx + 1 < n:
            self._print(f"{_epoch(trainer)}, batch {batch_idx + 1}/{n}", [])

    def on_predict_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int, *rest: Any
    ) -> None:
        is_due = self._count(batch_idx + 1)
        if self.bar and is_due:
            self.bar.show("evaluation", self.done, [self._left()])
        elif is_due and self.done < self.total:
            self._print(f"evaluation, batch {self.done}/{self.total}", [])

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self.bar:
            self.bar.show(f"{_epoch(trainer)}, evaluation", self.done, self._words())

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        metrics = epoch_metrics(trainer)
        found = {key: f"{metrics[key]:.4g}" for key in SHOWN if key in metrics}
        if self.bar:
            if found:
                self.errors = [f"test errors {' and '.join(found[key] for key in SHOWN[1:])} mm"]
            self.bar.show(_epoch(trainer), self.done, self._words())
        elif trainer.current_epoch + 1 in self.epochs:
            words = [f"{key} {value}" for key, value in found.items()] or [self._loss()]
            self._print(_epoch(trainer), words)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self.bar:
            self.bar.stop()

    on_predict_end = on_train_end

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        self.on_train_end(trainer, pl_module)

    def _start(self, trainer: Trainer, place: str, total: int, is_long: bool, stays: bool = True) -> None:
        """`is_long`: whether an epoch takes so long that there are lines within it."""
        self.total, self.is_long, self.done = total, is_long, 0
        self.times: list[float] = []
        self.last, self.tenth = math.inf, -1
        if self.bar and trainer.is_global_zero:
            self.bar.start(place, total, stays)

    def _count(self, done: int) -> bool:
        """Count a batch; returns whether to show it."""
        self.done, now = done, time.monotonic()
        self.times.append(now)
        if len(self.times) == 1:
            self.last = now
        if len(self.times) <= FEWEST and now < self.times[0] + LONGEST:
            return False
        if self.bar:
            is_due = now >= self.last + BETWEEN_LOOKS
        else:
            tenth = LINES * done // self.total
            is_due = now >= self.last + PATIENCE and (self.tenth < 0 or (self.is_long and tenth > self.tenth))
        self.last = now if is_due else self.last
        return is_due

    def _print(self, place: str, words: Sequence[str]) -> None:
        self.last, self.tenth = time.monotonic(), LINES * self.done // self.total
        self.say(f"{place}: {', '.join([*words, self._left()])}")

    def _words(self) -> list[str]:
        return [self._left(), self._loss(), *self.errors]

    def _loss(self) -> str:
        return f"loss {float(self.loss):.4g}"  # of the last batch

    def _name_smaller(self) -> None:
        """Once, with the first estimate."""
        smaller, self.smaller = self.smaller, ""
        if self._seconds_left() > LONG:
            self.say(f"{self._left()}; {smaller} takes a fraction of it")

    def _left(self) -> str:
        return f"about {duration(self._seconds_left())} left"

    def _seconds_left(self) -> float:
        """At the mean speed of the later half of the batches so far, since the first are slow, with evaluations."""
        later = self.times[len(self.times) // 2 :]
        return (time.monotonic() - later[0]) / max(len(later) - 1, 1) * (self.total - self.done)


class _Bar:
    """A bar on standard error; it shows nothing before `start`."""

    def __init__(self) -> None:
        self.bars: Bars | None = None

    def start(self, place: str, total: int, stays: bool) -> None:
        columns = (TextColumn("{task.description}"), BarColumn(bar_width=12), TextColumn("{task.fields[words]}"))
        # what is printed meanwhile appears above the bar, unless it goes to a file
        self.bars = Bars(
            *columns, console=Console(stderr=True), transient=not stays, redirect_stdout=sys.stdout.isatty()
        )
        self.bars.add_task(place, total=total, words="")
        self.bars.start()

    def show(self, place: str, done: int, words: Sequence[str]) -> None:
        if self.bars:
            self.bars.update(self.bars.task_ids[0], description=place, completed=done, words=", ".join(words))

    def stop(self) -> None:
        if self.bars:
            self.bars.stop()
        self.bars = None


def line_epochs(epochs: int, every: int) -> set[int]:
    """The epochs, from 1, that end with a line: every tenth of them, or the next evaluation if it is in that tenth.

    Examples:
        >>> sorted(line_epochs(3, 1)), sorted(line_epochs(42, 10))
        ([1, 2, 3], [5, 10, 13, 20, 21, 26, 30, 34, 40, 42])
    """
    tenths = sorted({math.ceil(line * epochs / LINES) for line in range(1, LINES + 1)})
    following = [*tenths[1:], epochs + 1]
    evaluated = [math.ceil(epoch / every) * every for epoch in tenths]
    return {
        evaluation if evaluation < end else epoch
        for epoch, evaluation, end in zip(tenths, evaluated, following, strict=True)
    }


def _epoch(trainer: Trainer) -> str:
    return f"epoch {trainer.current_epoch + 1}/{trainer.max_epochs}"

"""Lines that a training prints: the time left, and progress without a progress bar."""

import math
import time
from functools import partial
from typing import Any

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ProgressBar
from lightning.pytorch.utilities import rank_zero_only

from phd_exp.records.processes import duration
from phd_exp.training.recorder import epoch_metrics

FIRST_LINE = 5.0  # s after the first batch
BETWEEN_LINES = 30.0  # s
SHOWN = ("test/loss", "test/projected_error_mm", "test/depth_error_mm")


class Progress(Callback):
    """Prints the time left after the first batches; without a progress bar also every half minute and every epoch.

    Args:
        bar: the progress bar of the training; lines are printed above it.
    """

    def __init__(self, bar: ProgressBar | None = None) -> None:
        self.has_bar = bar is not None
        self.say = bar.print if bar else partial(print, flush=True)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.first: tuple[float, int] | None = None
        self.due = math.inf

    on_predict_start = on_train_start

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        n = int(trainer.num_training_batches)
        done = trainer.current_epoch * n + batch_idx + 1
        self._count(done, (trainer.max_epochs or 1) * n, f"{_epoch(trainer)}, batch {batch_idx + 1}/{n}")

    def on_predict_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int, *rest: Any
    ) -> None:
        if not self.has_bar:
            n = int(trainer.num_predict_batches[0])
            self._count(batch_idx + 1, n, f"evaluation, batch {batch_idx + 1}/{n}")

    @rank_zero_only
    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self.has_bar:
            return
        metrics = epoch_metrics(trainer)
        words = [f"{key} {metrics[key]:.4g}" for key in SHOWN if key in metrics]
        n, epochs = int(trainer.num_training_batches), trainer.max_epochs or 1
        left = self._left((trainer.current_epoch + 1) * n, epochs * n)
        self.say(f"{_epoch(trainer)}: {', '.join([*words, left])}")
        self.due = time.monotonic() + BETWEEN_LINES

    @rank_zero_only
    def _count(self, done: int, total: int, place: str) -> None:
        now = time.monotonic()
        if self.first is None:  # the first batch includes allocation and compilation
            self.first, self.due = (now, done), now + FIRST_LINE
        elif now >= self.due:
            self.due = math.inf if self.has_bar else now + BETWEEN_LINES
            self.say(f"{place}: {self._left(done, total)}")

    def _left(self, done: int, total: int) -> str:
        """The time left at the mean speed so far, evaluations included."""
        since, before = self.first or (time.monotonic(), done)
        return f"about {duration((time.monotonic() - since) / max(done - before, 1) * (total - done))} left"


def _epoch(trainer: Trainer) -> str:
    return f"epoch {trainer.current_epoch + 1}/{trainer.max_epochs}"

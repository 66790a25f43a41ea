"""Progress of a training: Lightning's bar on a terminal, elsewhere a line about every tenth of the run."""

import sys
import time
from collections.abc import Mapping
from typing import Any

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import TQDMProgressBar

from phd_exp.records.processes import duration

LINES = 10  # of a training, about
WARM_UP = 5  # batches that are slower, and spoil no later estimate; after as many others the first line is printed
BETWEEN_LOOKS = 0.5  # s between two readings of the loss, which a GPU would have to wait for
SHOWN = ("test/projected_error_mm", "test/depth_error_mm")


class Progress(TQDMProgressBar):
    """Shows the epoch, from 1, the time left of the whole training, the loss, and the errors of the last evaluation.

    Where standard output is no terminal, lines follow the tenth batch and epochs, about ten in all.
    """

    def __init__(self) -> None:
        super().__init__()
        if not sys.stdout.isatty():
            self.disable()

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        super().on_train_start()
        self.total = int(trainer.estimated_stepping_batches)
        self.start = self.first = trainer.global_step
        self.begun, self.looked = time.monotonic(), 0.0
        self.loss: Any = None
        self.shown: dict[str, Any] = {}

    def on_train_epoch_start(self, trainer: Trainer, *rest: Any) -> None:
        super().on_train_epoch_start(trainer)
        self.train_progress_bar.set_description(_epoch(trainer))

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        self.loss, done = outputs["loss"], trainer.global_step - self.start
        if done == WARM_UP:
            self.first, self.begun = trainer.global_step, time.monotonic()
        super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)
        if done == 2 * WARM_UP:
            self._line(trainer)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.looked = 0.0
        super().on_train_epoch_end(trainer, pl_module)
        before, after = (LINES * (trainer.current_epoch + n) // (trainer.max_epochs or 1) for n in (0, 1))
        if after > before:
            self._line(trainer)

    def get_metrics(self, trainer: Trainer, pl_module: LightningModule) -> dict[str, Any]:
        """What the bar shows; it is read anew twice a second."""
        if time.monotonic() > self.looked + BETWEEN_LOOKS:
            self.shown, self.looked = self._words(trainer), time.monotonic()
        return self.shown

    def _words(self, trainer: Trainer) -> dict[str, Any]:
        """Time left at the mean speed after the warm-up, with evaluations; loss of the last batch; errors."""
        done = trainer.global_step - self.first
        left = (time.monotonic() - self.begun) / max(done, 1) * (self.total - trainer.global_step)
        metrics: Mapping[str, Any] = trainer.callback_metrics
        found = {key: f"{float(metrics[key]):.4g}" for key in SHOWN if key in metrics}
        return {"left": duration(left), "loss": f"{float(self.loss):.4g}"} | found

    def _line(self, trainer: Trainer) -> None:
        if trainer.is_global_zero and self.is_disabled:
            words = ", ".join(f"{key} {value}" for key, value in self._words(trainer).items())
            print(f"{_epoch(trainer)}: {words}", flush=True)


def _epoch(trainer: Trainer) -> str:
    return f"epoch {trainer.current_epoch + 1}/{trainer.max_epochs}"

"""What a run writes down while it trains: one line of metrics an epoch, and calibration curves now and then."""

import json
import math
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint
from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities import rank_zero_only

from phd_exp.data.batches import Batch
from phd_exp.distributions.columns import Columns
from phd_exp.models.heads import Prediction
from phd_exp.records.files import write_atomic
from phd_exp.records.runs import RunFolder, epoch_name
from phd_exp.training.predictions import calibration_curves, columns, gathered, joined
from phd_exp.training.tracking import Tracker

SHOWN = ("test/loss", "test/projected_error_mm", "test/depth_error_mm")

CalibrationData = dict[str, dict[str, Any]]
Draw = Callable[[CalibrationData, Path], None]
"""Draws calibration curves into a picture file."""


class RecordLogger(Logger):
    """Writes what Lightning logs to the run record: one line an epoch, both splits together.

    The file is written whole every time, so that a resumed run replaces the epochs it repeats and no reader ever
    sees half a line.
    """

    def __init__(self, folder: RunFolder) -> None:
        super().__init__()
        self.folder = folder
        self.rows = {row["epoch"]: row for row in folder.metrics()}

    @property
    def name(self) -> str:
        return "record"

    @property
    def version(self) -> str:
        return ""

    @rank_zero_only
    def log_hyperparams(self, params: dict[str, Any] | Namespace, *args: Any, **kwargs: Any) -> None:
        """Nothing: config.yaml holds them already."""

    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        epoch = int(metrics["epoch"])
        values = {key: value for key, value in metrics.items() if key != "epoch"}
        finite = {key: value if math.isfinite(value) else None for key, value in values.items()}
        self.rows[epoch] = self.rows.get(epoch, {"epoch": epoch}) | {"step": step} | finite
        self._write()

    @rank_zero_only
    def _write(self) -> None:
        self.folder.write_metrics(self.rows[key] for key in sorted(self.rows))

    def forget_after(self, epoch: int) -> None:
        """Drop the epochs that a resumed run will train again."""
        self.rows = {key: row for key, row in self.rows.items() if key <= epoch}


class RecordBeforeCheckpoint(Checkpoint):
    """Has an epoch in the record before there is a checkpoint of it.

    Lightning logs what training measured after its checkpoints are written: a run that is killed in between would go
    on with the next epoch, and this one would stay half recorded. Being a Checkpoint, this comes after the module.
    """

    def __init__(self, record: RecordLogger) -> None:
        self.record = record

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        evaluated = (trainer.current_epoch + 1) % (trainer.check_val_every_n_epoch or 1) == 0
        values = {
            key: float(value)
            for key, value in trainer.callback_metrics.items()
            if evaluated or not key.startswith("test/")  # Lightning keeps what was measured epochs ago
        }
        step = trainer.global_step - 1  # as Lightning counts when it logs
        self.record.log_metrics({"epoch": trainer.current_epoch} | values, step=step)


class Begun(Callback):
    """Tells whether the first epoch has begun: what goes wrong before lies in what was taken up."""

    training = False

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.training = True


class EpochLines(Callback):
    """One line an epoch, for where a progress bar would be noise: log files, pipes."""

    @rank_zero_only
    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        metrics = {
            key: float(trainer.callback_metrics[key]) for key in SHOWN if key in trainer.callback_metrics
        }
        values = ", ".join(f"{key} {value:.4g}" for key, value in metrics.items())
        print(f"epoch {trainer.current_epoch + 1}/{trainer.max_epochs}: {values}", flush=True)


class CalibrationRecorder(Callback):
    """Every n epochs, and at the end, the calibration curves of the test split, as data and as pictures."""

    def __init__(
        self, folder: RunFolder, window: int, every_n_epochs: int, draw: Draw | None, tracker: Tracker | None
    ) -> None:
        self.folder = folder
        self.window = window
        self.every_n_epochs = every_n_epochs
        self.draw = draw
        self.tracker = tracker
        self.parts: list[Columns] = []

    def is_due(self, trainer: Trainer) -> bool:
        """Whether the present epoch is one whose curves are kept."""
        return not trainer.sanity_checking and (trainer.current_epoch + 1) % self.every_n_epochs == 0

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.parts = []

    def on_validation_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Prediction,  # type: ignore[override]  # what validation_step returns
        batch: Batch,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        if self.is_due(trainer):
            self.parts.append(columns(outputs, batch))

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not self.parts:
            return
        self.write(epoch_name(trainer.current_epoch), gathered(joined(self.parts)), trainer.global_step)

    @rank_zero_only
    def write(self, name: str, table: Columns, step: int) -> None:
        """Write the curves of a table of predictions into the record, draw them and send them."""
        curves = {key: curve.as_data() for key, curve in calibration_curves(table, self.window).items()}
        self.folder.calibration.mkdir(parents=True, exist_ok=True)
        file = self.folder.curves(name)
        write_atomic(file, json.dumps(curves) + "\n")
        if self.draw is not None:
            self.draw(curves, file.with_suffix(".png"))
        if self.tracker is not None:
            self.tracker.send_calibration(name, step)

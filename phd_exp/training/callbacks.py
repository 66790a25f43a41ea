"""What a run writes down while it trains: one line of metrics an epoch, and calibration curves now and then."""

import json
import math
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import Logger, WandbLogger
from lightning.pytorch.utilities import rank_zero_only

from phd_exp.data.batches import Batch
from phd_exp.distributions.columns import Columns
from phd_exp.metrics.calibration import CalibrationCurve
from phd_exp.models.heads import Prediction
from phd_exp.records.files import write_atomic
from phd_exp.records.runs import RunFolder
from phd_exp.training.predictions import calibration_curves, columns, joined

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

    @rank_zero_only
    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        epoch = int(metrics["epoch"])
        values = {key: value for key, value in metrics.items() if key != "epoch"}
        finite = {key: value if math.isfinite(value) else None for key, value in values.items()}
        self.rows[epoch] = self.rows.get(epoch, {"epoch": epoch}) | {"step": step} | finite
        self.folder.write_metrics(self.rows[key] for key in sorted(self.rows))

    def forget_after(self, epoch: int) -> None:
        """Drop the epochs that a resumed run will train again."""
        self.rows = {key: row for key, row in self.rows.items() if key <= epoch}


class EpochLines(Callback):
    """One line an epoch, for where a progress bar would be noise: log files, pipes."""

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        metrics = {
            key: float(trainer.callback_metrics[key]) for key in SHOWN if key in trainer.callback_metrics
        }
        values = ", ".join(f"{key} {value:.4g}" for key, value in metrics.items())
        print(f"epoch {trainer.current_epoch + 1}/{trainer.max_epochs}: {values}", flush=True)


class CalibrationRecorder(Callback):
    """Every n epochs, and after the last, the calibration curves of the test split, as data and as pictures."""

    def __init__(self, folder: RunFolder, window: int, every_n_epochs: int, draw: Draw | None) -> None:
        self.folder = folder
        self.window = window
        self.every_n_epochs = every_n_epochs
        self.draw = draw
        self.parts: list[Columns] = []

    def is_due(self, trainer: Trainer) -> bool:
        epoch = trainer.current_epoch + 1
        last = epoch == trainer.max_epochs
        return not trainer.sanity_checking and (last or epoch % self.every_n_epochs == 0)

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
        curves = self.write(f"epoch-{trainer.current_epoch:04d}", joined(self.parts))
        for logger in trainer.loggers:
            if isinstance(logger, WandbLogger):
                self._send(logger, curves, trainer)

    def write(self, name: str, table: Columns) -> CalibrationData:
        """Write the curves of a table of predictions into the record, and draw them; returns them as data."""
        curves = {key: _as_data(curve) for key, curve in calibration_curves(table, self.window).items()}
        self.folder.calibration.mkdir(parents=True, exist_ok=True)
        write_atomic(self.folder.calibration / f"{name}.json", json.dumps(curves) + "\n")
        if self.draw is not None:
            self.draw(curves, self._picture(name))
        return curves

    def _send(self, logger: WandbLogger, curves: CalibrationData, trainer: Trainer) -> None:
        points = [
            [name, *point]
            for name, curve in curves.items()
            for point in zip(curve["predicted"], curve["empirical"], strict=True)
        ]
        header = ["curve", "predicted", "empirical"]
        logger.log_table("test/calibration_curves", header, points, step=trainer.global_step)
        picture = self._picture(f"epoch-{trainer.current_epoch:04d}")
        if picture.exists():
            logger.log_image("test/calibration", [str(picture)], step=trainer.global_step)

    def _picture(self, name: str) -> Path:
        return self.folder.calibration / f"{name}.png"


def _as_data(curve: CalibrationCurve) -> dict[str, Any]:
    return {
        "window": curve.window,
        "left_out": curve.left_out,
        "predicted": curve.predicted.tolist(),
        "empirical": curve.empirical.tolist(),
    }

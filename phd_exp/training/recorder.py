"""The record of a run during training: one line of metrics per epoch, and calibration curves."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint
from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities import rank_zero_only

from phd_exp.config.sections import EvaluationConfig
from phd_exp.distributions.columns import Columns
from phd_exp.records.errors import ConfigError, unknown
from phd_exp.records.files import write_atomic
from phd_exp.records.runs import RunFolder, epoch_name
from phd_exp.training.predictions import TRAINING, calibration_curves

CalibrationData = dict[str, dict[str, Any]]
Draw = Callable[[CalibrationData, Path], None]
"""Draws calibration curves to an image file."""


class Recorder(Checkpoint):
    """Keeps the run record up to date, and sends pictures and earlier epochs to the loggers.

    `metrics.jsonl` is rewritten after every epoch, since a resumed run replaces the epochs it repeats. Lightning
    calls Checkpoint callbacks after the module's hooks, and this one before ModelCheckpoint, so an epoch is recorded
    before its checkpoint exists.

    Args:
        folder: the record of the run.
        evaluation: interval and window of the calibration curves.
        draw: draws the curves; None records their data alone.
        loggers: Lightning's loggers; those with `log_image` receive the pictures.

    Attributes:
        begun: whether training has begun in this process; an earlier error comes from the checkpoint.
    """

    def __init__(
        self, folder: RunFolder, evaluation: EvaluationConfig, draw: Draw | None, loggers: Sequence[Logger]
    ) -> None:
        self.folder = folder
        self.evaluation = evaluation
        self.draw = draw
        self.loggers = loggers
        self.rows = {row["epoch"]: row for row in folder.metrics()}
        self.begun = False

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        evaluated = [key.removeprefix("test/") for key in self.rows[min(self.rows)] if key.startswith("test/")]
        require_monitored(trainer, evaluated)
        self.begun = True

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        # before the module's hook, which resets the rows
        pl_module.require_finite()  # type: ignore[operator]  # a PositionModule's
        if has_curves(trainer.current_epoch + 1, self.evaluation):
            table = pl_module.evaluation_rows.columns()  # type: ignore[operator, union-attr]  # a PositionModule's
            self.record_curves(epoch_name(trainer.current_epoch), table, trainer.global_step)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        step = trainer.global_step - 1  # as Lightning counts
        self.record(trainer.current_epoch, epoch_metrics(trainer), step)

    def record(self, epoch: int, metrics: Mapping[str, float], step: int) -> None:
        """Write the metrics of an epoch, with null for numbers that are not finite."""
        finite = {key: value if math.isfinite(value) else None for key, value in metrics.items()}
        self.rows[epoch] = {"epoch": epoch, "step": step} | finite
        rank_zero_only(self.folder.write_metrics)(self.rows[key] for key in sorted(self.rows))

    def forget_after(self, epoch: int) -> None:
        """Drop the epochs that a resumed run repeats."""
        self.rows = {key: row for key, row in self.rows.items() if key <= epoch}

    @rank_zero_only
    def record_curves(self, name: str, table: Columns, step: int) -> None:
        """Write, draw and send the calibration curves of a table; a point estimate has none."""
        curves = calibration_curves(table, self.evaluation.calibration_window)
        if not curves:
            return
        self.folder.calibration.mkdir(parents=True, exist_ok=True)
        file = self.folder.curves(name)
        content = {key: curve.as_data() for key, curve in curves.items()}
        write_atomic(file, json.dumps(content) + "\n")
        if self.draw is not None:
            self.draw(content, file.with_suffix(".png"))
        self._send_picture(name, step)

    def send_recorded(self) -> None:
        """Send the recorded epochs, which an earlier process trained, to the loggers."""
        for epoch, row in self.rows.items():
            metrics = {key: value for key, value in row.items() if key != "step" and value is not None}
            for logger in self.loggers:
                logger.log_metrics(metrics, step=row["step"])
            self._send_picture(epoch_name(epoch), row["step"])

    def _send_picture(self, name: str, step: int) -> None:
        picture = self.folder.curves(name).with_suffix(".png")
        for logger in self.loggers:
            if picture.exists() and hasattr(logger, "log_image"):
                logger.log_image("test/calibration", [str(picture)], step=step)


def has_curves(epochs: int, evaluation: EvaluationConfig) -> bool:
    """Whether the evaluation after so many epochs is the nearest to a multiple of `calibration_every_n_epochs`.

    Of two equally near ones it is the earlier.
    """
    wanted, half = evaluation.calibration_every_n_epochs, evaluation.every_n_epochs / 2
    return (epochs + half) // wanted > (epochs - half) // wanted


def require_monitored(trainer: Trainer, evaluated: Sequence[str]) -> None:
    """Raise ConfigError if a callback monitors what is not logged, before hours of training.

    Callbacks of the user's own may log further metrics: with one of these, the others may monitor anything.
    """
    callbacks: list[Any] = trainer.callbacks  # type: ignore[attr-defined]
    if not all(type(one).__module__.startswith(("lightning.", "phd_exp.")) for one in callbacks):
        return
    known = [f"held_out/{name}" for name in evaluated]
    known += [f"train/{name}" for name in evaluated if name in TRAINING]
    for one in callbacks:
        if (monitor := getattr(one, "monitor", None)) is not None and monitor not in known:
            fault = f"not logged, but monitored by {type(one).__name__}"
            raise ConfigError(f"callbacks: {unknown(str(monitor), known, fault=fault)}")


def epoch_metrics(trainer: Trainer) -> dict[str, float]:
    """The metrics of the current epoch; those of training alone if nothing else was evaluated."""
    evaluated = (trainer.current_epoch + 1) % (trainer.check_val_every_n_epoch or 1) == 0
    return {
        key: float(value)
        for key, value in trainer.callback_metrics.items()
        if evaluated or not key.startswith(("test/", "held_out/"))  # else of an earlier epoch
    }

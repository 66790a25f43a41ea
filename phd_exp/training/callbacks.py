"""Progress where no bar can be drawn."""

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.utilities import rank_zero_only

SHOWN = ("test/loss", "test/projected_error_mm", "test/depth_error_mm")


class EpochLines(Callback):
    """One line an epoch, for where a progress bar would be noise: log files, pipes."""

    @rank_zero_only
    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        metrics = {
            key: float(trainer.callback_metrics[key]) for key in SHOWN if key in trainer.callback_metrics
        }
        values = ", ".join(f"{key} {value:.4g}" for key, value in metrics.items())
        print(f"epoch {trainer.current_epoch + 1}/{trainer.max_epochs}: {values}", flush=True)

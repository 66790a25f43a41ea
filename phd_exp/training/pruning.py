"""The part of a search that runs inside a training: it reports held-out scores and stops trials without prospects."""

from pathlib import Path
from typing import Any
from warnings import catch_warnings

from lightning import Callback, LightningModule, Trainer

from phd_exp.evaluation.parquet import read_table
from phd_exp.records.runs import RunFolder, choosing

SCORES = ("nll", "depth_error_mm")
"""What searches and sweepers minimise: the first of them that the model has. A baseline has no likelihood."""


class Pruned(SystemExit):
    """The trial was stopped by the search; its run is interrupted, and can be resumed."""


class Pruning(Callback):
    """Reports the held-out score of every evaluated epoch to a trial of Optuna, and stops it if that says so."""

    def __init__(self, trial: Any) -> None:
        self.trial = trial

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        metrics, epoch = trainer.callback_metrics, trainer.current_epoch
        score = next(float(metrics[key]) for key in map("held_out/{}".format, SCORES) if key in metrics)
        with catch_warnings(action="ignore"):  # of epochs that a resumed trial reports again
            self.trial.report(score, epoch)
        if self.trial.should_prune():
            raise Pruned(
                f"pruned after epoch {epoch + 1} of {trainer.max_epochs} with a held-out score of {score:.4g}"
            )


def held_out_score(run: Path) -> tuple[str, float]:
    """The metric that searches and sweepers minimise, and its mean over the rows `choosing`. Raises RunError."""
    table = read_table(RunFolder(run).held_out)
    name = next(name for name in SCORES if name in table)
    return f"held_out/{name}", float(table[name][choosing(table)].mean())

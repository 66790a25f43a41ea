"""Trains and evaluates one run in this process."""

import logging
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from lightning import Callback, Trainer, seed_everything

from phd_exp.config import RunConfig
from phd_exp.data.batches import BatchLoader
from phd_exp.data.datamodule import PositionData
from phd_exp.data.images import SHRINKING
from phd_exp.data.photometry import VERSION
from phd_exp.data.sources import PARTS
from phd_exp.distributions.columns import Columns
from phd_exp.models.weights import ADVICE, load_checkpoint
from phd_exp.records.errors import RunError, gist, shown
from phd_exp.records.runs import RunFolder
from phd_exp.training.build import build_data, build_module
from phd_exp.training.module import PositionModule
from phd_exp.training.predictions import summary, write_parquet
from phd_exp.training.recorder import Draw, Recorder
from phd_exp.training.tracking import send_results, tracked
from phd_exp.training.trainer import build_trainer

INTENDED = (
    ".*LeafSpec.*is deprecated",  # Lightning calls a deprecated name of torch
    "Precision .* is not supported by the model summary",
    "Checkpoint directory .* exists and is not empty",  # an interrupted run resumes in the same folder
    r"Found .* module\(s\) in eval mode",  # BatchNorm that keeps its means and variances
    "It is recommended to use .*sync_dist=True",  # the logged values are already sums over all processes
)
"""Warnings about what a run does on purpose."""
UNTRAINED = -1  # the number of the epoch before the first, whose metrics are those of the untrained network


def run(
    config: RunConfig,
    folder: RunFolder,
    draw: Draw | None,
    threads: int,
    rank: int = 0,
    callbacks: Sequence[Callback] = (),
) -> dict[str, Any]:
    """Run in this process: the whole run, or one rank of several that train together (`ranks.py`).

    Every rank computes and returns the results; rank 0 alone writes the record.
    """
    quiet_lightning()
    torch.set_num_threads(threads)
    seed_everything(config.seed, verbose=False)
    data = build_data(config, rank)
    data.setup()
    if rank == 0:
        constants = asdict(data.source.depth) | {"constant_f": data.source.constant_f}
        folder.write_constants(constants | {"shrinking": SHRINKING, "photometry": VERSION})
    module = build_module(config, data)
    with tracked(config.logger if rank == 0 else {}, config.model_dump(mode="json"), folder) as loggers:
        recorder = Recorder(folder, config.evaluation, draw, loggers)
        trainer = build_trainer(config, recorder, callbacks)
        data.move_to(trainer.strategy.root_device)
        training = Training(trainer, module, data, recorder)
        training.fit()
        results = training.measure() | {
            "preset": config.preset,
            "recipe": config.recipe.name,
            "data": config.data.name,
            "model": config.model.name,
            "seed": config.seed,
            **training.circumstances(),
        }
        send_results(loggers, results)
    return results


@dataclass(frozen=True)
class Training:
    """The built parts of a run: Lightning's trainer, the module, its data and the recorder."""

    trainer: Trainer
    module: PositionModule
    data: PositionData
    recorder: Recorder

    def fit(self) -> None:
        """Train to the last epoch, from the last checkpoint if there is one.

        A new run has none; the metrics of its untrained network are recorded first.

        Raises RunError if no epoch was trained, or if the checkpoint, or the record of the epochs before it, does not
        belong to this run.
        """
        checkpoint = self.recorder.folder.last_checkpoint
        if checkpoint.exists():
            self._resume(checkpoint)
        else:
            self.recorder.forget_after(UNTRAINED)
            self.recorder.record(UNTRAINED, summary(self.evaluate(self.data.in_order("test"))), step=0)
            self.recorder.send_recorded()
            self.trainer.fit(self.module, datamodule=self.data)
        if not checkpoint.exists():
            raise RunError(
                f"{self.recorder.folder.path}: trained no whole epoch, so there is no run; set other arguments of "
                "trainer"
            )

    def _resume(self, checkpoint: Path) -> None:
        trainer, recorder = self.trainer, self.recorder
        content, epochs = load_checkpoint(checkpoint), trainer.max_epochs or 0
        epoch = content.get("epoch")
        if type(epoch) is not int or not 0 <= epoch < epochs:
            raise RunError(f"{checkpoint}: not a checkpoint of this run (epoch {shown(epoch)} of {epochs}); {ADVICE}")
        is_whole = _ends_an_epoch(content)
        recorder.forget_after(epoch if is_whole else epoch - 1)
        if not any(key.startswith("test/") for key in recorder.rows.get(UNTRAINED, {})):
            raise RunError(
                f"{recorder.folder.metrics_file}: not the record of the epochs before {checkpoint.name}; "
                "delete both to begin the run again"
            )
        if trainer.is_global_zero and epoch + is_whole < epochs:
            print(f"{recorder.folder.path}: resuming at epoch {epoch + is_whole + 1} of {epochs}", flush=True)
        recorder.send_recorded()
        try:
            trainer.fit(self.module, datamodule=self.data, ckpt_path=checkpoint, weights_only=True)
        except (KeyError, ValueError, TypeError, AttributeError, RuntimeError, IndexError) as error:
            if recorder.begun:
                raise
            raise RunError(f"{checkpoint}: not a checkpoint of this run ({gist(error)}); {ADVICE}") from None

    def evaluate(self, loader: BatchLoader) -> Columns:
        """The rows of all samples of a loader with the current weights, gathered from all processes."""
        self.trainer.predict(self.module, dataloaders=loader, return_predictions=False)
        table = self.module.evaluation_rows.columns()
        self.module.evaluation_rows.reset()
        return table

    def measure(self) -> dict[str, float]:
        """Evaluate the best weights on the test and held-out samples, and record the tables.

        Returns the test metrics, and those of the untrained network.
        """
        folder = self.recorder.folder
        if (best := folder.best_checkpoint) != folder.last_checkpoint:
            self.module.load_state_dict(load_checkpoint(best)["state_dict"])
        tables = {part: self.evaluate(self.data.in_order(part)) for part in self.data.samples if part != "train"}
        if self.trainer.is_global_zero:
            self.recorder.record_curves("final", tables["test"], self.trainer.global_step)
            for part, table in tables.items():
                file = folder.held_out if part == "held_out" else folder.predictions
                write_parquet(file, table, self.data.source.known(part))
        untrained = self.recorder.rows[UNTRAINED].items()
        return summary(tables["test"]) | {f"untrained/{key}": value for key, value in untrained if "test/" in key}

    def circumstances(self) -> dict[str, Any]:
        """Numbers of samples and epochs, device, threads and precision."""
        device = self.trainer.strategy.root_device
        return {
            **{f"n_{part}": self.data.source.count(part) for part in PARTS},
            "epochs": self.trainer.current_epoch,
            "devices": self.trainer.world_size,
            "threads": torch.get_num_threads(),  # of each process
            "device": torch.cuda.get_device_name(device) if device.type == "cuda" else str(device),
            "precision": str(self.trainer.precision),
        }


def _ends_an_epoch(checkpoint: Mapping[str, Any]) -> bool:
    """Whether a checkpoint was taken after the last batch of an epoch, as Lightning records it."""
    try:
        return bool(checkpoint["loops"]["fit_loop"]["epoch_loop.batch_progress"]["is_last_batch"])
    except (KeyError, TypeError):
        return True


def quiet_lightning() -> None:
    """Silence Lightning's remarks, except a profiler's, and the warnings about intended behaviour."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.ERROR)
    logging.getLogger("lightning.pytorch.profilers").setLevel(logging.INFO)
    for intended in INTENDED:
        warnings.filterwarnings("ignore", intended)

"""Checkpoints that are complete or absent, and one when a signal arrives in the middle of an epoch."""

import io
import signal
import threading
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint
from lightning.pytorch.plugins.io import CheckpointIO

from phd_exp.records.files import write_atomic
from phd_exp.training.network import load_checkpoint

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class AtomicCheckpoints(CheckpointIO):
    """Writes a checkpoint to a temporary file in the same folder and renames it.

    Lightning's default writes to the system's folder for temporary files. Moving from there to another file system is
    a copy: a kill during the copy leaves half a checkpoint and a large stray file.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        content = io.BytesIO()
        torch.save(checkpoint, content)
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, content.getvalue())

    def load_checkpoint(
        self, path: Any, map_location: Any = None, weights_only: bool | None = True
    ) -> dict[str, Any]:
        content = load_checkpoint(Path(path), map_location)
        # the ModelCheckpoint of the run, which monitors nothing, would delete the file it calls the best
        states = {key: state for key, state in content.get("callbacks", {}).items() if "'monitor': None" not in key}
        return content | {"callbacks": states}

    def remove_checkpoint(self, path: Any) -> None:
        Path(path).unlink(missing_ok=True)


class StopBetweenBatches(Checkpoint):
    """Delays a SIGINT or SIGTERM to the end of the batch, saves a checkpoint, and raises the signal again.

    The handlers that were installed before the training receive it. During the last batch and the validation the
    signal waits for the checkpoint of the epoch: as a Checkpoint callback this one runs in the order of the Trainer's
    list, and belongs after ModelCheckpoint. A second signal is raised at once.
    """

    def __init__(self, checkpoint: Path) -> None:
        self.checkpoint = checkpoint
        self.handlers: dict[int, Any] = {}
        self.received: int | None = None

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if threading.current_thread() is threading.main_thread():  # Python handles signals there only
            self.handlers = {signum: signal.signal(signum, self._receive) for signum in SIGNALS}

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *arguments: Any) -> None:
        # after the last batch of an epoch its validation follows, and the checkpoint of the whole epoch
        if self.received is not None and not trainer.is_last_batch:
            trainer.save_checkpoint(self.checkpoint)
            self._raise()

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self.received is not None:
            self._raise()

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._restore()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        self._restore()

    def _receive(self, signum: int, frame: FrameType | None) -> None:
        if self.received is not None:
            self._raise()
        self.received = signum

    def _raise(self) -> None:
        assert self.received is not None
        self._restore()
        signal.raise_signal(self.received)

    def _restore(self) -> None:
        for signum, handler in self.handlers.items():
            signal.signal(signum, handler)
        self.handlers = {}

"""Checkpoints that are complete or absent and name no foreign file, and one when a signal arrives during an epoch."""

import io
import os
import signal
import threading
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint
from lightning.pytorch.plugins.io import CheckpointIO

from phd_exp.models.weights import load_checkpoint
from phd_exp.records.errors import RunError
from phd_exp.records.files import write_atomic
from phd_exp.records.runs import RunFolder

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class AtomicCheckpoints(CheckpointIO):
    """The checkpoints of one run: written to a temporary file in the same folder and renamed, never naming a file
    outside `checkpoints/` when read, and deleted inside the run's folder alone.

    Lightning's default writes to the system's folder for temporary files. Moving from there to another file system is
    a copy: a kill during the copy leaves half a checkpoint and a large stray file.
    """

    def __init__(self, folder: RunFolder) -> None:
        self.folder = folder

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        content = io.BytesIO()
        torch.save(checkpoint, content)
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, content.getvalue())

    def load_checkpoint(
        self, path: Any, map_location: Any = None, weights_only: bool | None = True
    ) -> dict[str, Any]:
        return at_home(load_checkpoint(Path(path), map_location), self.folder.checkpoints.resolve())

    def remove_checkpoint(self, path: Any) -> None:
        """Delete a checkpoint. Raises RunError for a file outside the run's folder, which is somebody else's."""
        file = Path(path)
        if not file.parent.resolve().is_relative_to(self.folder.path.resolve()):
            raise RunError(f"{file}: not deleted, since it is outside {self.folder.path}; move it away yourself")
        file.unlink(missing_ok=True)


def at_home(content: Any, checkpoints: Path) -> Any:
    """The content of a checkpoint, changed so that each path in it names a file directly in `checkpoints`.

    Callbacks delete and upload the files that they find in a checkpoint, which a stranger may have written. Those of
    a run that was moved are found again.

    Examples:
        >>> at_home({"best": "/old/checkpoints/best.ckpt", "monitor": "held_out/loss"}, Path("checkpoints"))
        {'best': 'checkpoints/best.ckpt', 'monitor': 'held_out/loss'}
    """
    if isinstance(content, str):
        leads_away = content.startswith(("/", "~")) or "://" in content or ".." in Path(content).parts
        # a single word that names a folder here, such as `test`, may be anything else
        if leads_away or os.path.isfile(content) or ("/" in content and os.path.lexists(content)):
            name = Path(content).name
            return str(checkpoints if name in ("..", checkpoints.name) else checkpoints / name)
    if isinstance(content, dict):  # in place, which keeps its class
        changed = {at_home(key, checkpoints): at_home(value, checkpoints) for key, value in content.items()}
        content.clear()
        content.update(changed)
    if type(content) in (list, tuple, set):
        return type(content)(at_home(value, checkpoints) for value in content)
    return content


class StopBetweenBatches(Checkpoint):
    """Delays a SIGINT or SIGTERM to the end of the batch, saves a checkpoint, and raises the signal again.

    During the last batch and the validation the signal waits for the checkpoint of the epoch: this callback belongs
    after ModelCheckpoint in the Trainer's list. A second signal is raised at once. The handlers that were installed
    before the training receive it.
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
            self._raise(self.received)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self.received is not None:
            self._raise(self.received)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._restore()

    def on_exception(self, *arguments: Any) -> None:
        self._restore()

    def _restore(self) -> None:
        for signum, handler in self.handlers.items():
            signal.signal(signum, handler)
        self.handlers = {}

    def _receive(self, signum: int, frame: FrameType | None) -> None:
        if self.received is not None:
            self._raise(signum)
        self.received = signum

    def _raise(self, signum: int) -> None:
        self._restore()
        signal.raise_signal(signum)

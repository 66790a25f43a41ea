"""A signal in the middle of an epoch: what was done so far is kept before the process stops."""

import signal
import threading
from pathlib import Path
from types import FrameType
from typing import Any

from lightning import Callback, LightningModule, Trainer

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StopBetweenBatches(Callback):
    """Lets a SIGINT or SIGTERM wait for the end of the batch, has a checkpoint written, and then hands it on.

    What it is handed on to is whatever handled it before the training began. While an epoch is validated it waits for
    the checkpoint that comes after that. A second signal waits for nothing.
    """

    def __init__(self, checkpoint: Path) -> None:
        self.checkpoint = checkpoint
        self.handlers: dict[int, Any] = {}
        self.noted: int | None = None

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if threading.current_thread() is threading.main_thread():  # elsewhere Python handles no signals
            self.handlers = {signum: signal.signal(signum, self._note) for signum in SIGNALS}

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *arguments: Any) -> None:
        # after the last batch of an epoch its validation follows, and the checkpoint of the whole epoch
        if self.noted is not None and not trainer.is_last_batch:
            trainer.save_checkpoint(self.checkpoint)
            self._hand_on()

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self.noted is not None:
            self._hand_on()

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._restore()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        self._restore()

    def _note(self, signum: int, frame: FrameType | None) -> None:
        if self.noted is not None:
            self._hand_on()
        self.noted = signum

    def _hand_on(self) -> None:
        assert self.noted is not None
        self._restore()
        signal.raise_signal(self.noted)

    def _restore(self) -> None:
        for signum, handler in self.handlers.items():
            signal.signal(signum, handler)
        self.handlers = {}

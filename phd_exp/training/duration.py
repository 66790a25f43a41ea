"""How long a training step takes on this machine."""

import time
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from torch.utils.data import DataLoader

from phd_exp.config import RunConfig
from phd_exp.data.batches import Batch
from phd_exp.hardware import default_threads, precision
from phd_exp.training.build import build_data, build_module
from phd_exp.training.run import quiet_lightning

ENOUGH = 5.0  # seconds of steps
MOST = 100  # steps


class _Clock(Callback):
    """Notes when each step ends, and stops the training when there are enough."""

    def __init__(self) -> None:
        self.times: list[float] = []

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        self.times.append(time.monotonic())
        trainer.should_stop = len(self.times) > 1 and self.times[-1] - self.times[0] > ENOUGH


def seconds_a_step(config: RunConfig, threads: int) -> float:
    """The mean time of the first training steps of a run, measured on random images for five seconds."""
    quiet_lightning()
    torch.set_num_threads(config.trainer.threads or default_threads(threads))
    data, clock, n, side = build_data(config), _Clock(), config.data.batch_size, config.data.image_size
    image = torch.randint(0, 256, (n, side, side, 3), dtype=torch.uint8)
    xyz = torch.tensor([0.0, 0.0, data.source.depth.z_centre]).expand(n, 3)
    batch = Batch(image, xyz, torch.full((n,), data.source.constant_f), float(side), torch.arange(n))
    trainer = Trainer(
        accelerator=config.trainer.accelerator,
        precision=precision(config.trainer.accelerator, config.trainer.precision),
        max_epochs=1,
        logger=False,
        callbacks=[clock],
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        limit_val_batches=0,
    )
    trainer.fit(build_module(config, data), DataLoader([batch] * MOST, batch_size=None))  # type: ignore[arg-type]  # a list
    first, *_, last = clock.times  # without the first step, which includes allocation and compilation
    return (last - first) / (len(clock.times) - 1)

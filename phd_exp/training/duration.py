"""How long a training step takes on this machine."""

import time
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from torch.utils.data import DataLoader

from phd_exp.data.batches import Batch
from phd_exp.data.sources import Source
from phd_exp.training.build import build_data, build_module
from phd_exp.training.config import RunConfig
from phd_exp.training.network import precision
from phd_exp.training.run import quiet_lightning

ENOUGH = 5.0  # seconds of steps
MOST = 100  # steps


class _Clock(Callback):
    """Measures the mean time of a step, without the first, which includes allocation and compilation."""

    def __init__(self) -> None:
        self.times: list[float] = []

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        self.times.append(time.monotonic())
        trainer.should_stop = len(self.times) > 1 and self.times[-1] - self.times[0] > ENOUGH

    @property
    def seconds(self) -> float:
        return (self.times[-1] - self.times[0]) / (len(self.times) - 1)


def seconds_a_step(config: RunConfig, threads: int) -> float:
    """The mean time of the first training steps of a run, measured on random images for five seconds."""
    quiet_lightning()
    torch.set_num_threads(config.trainer.threads or threads)
    data, clock = build_data(config), _Clock()
    batch = _random_batch(data.source, config.data.batch_size, config.data.image_size)
    trainer = Trainer(
        accelerator=config.trainer.accelerator,
        precision=precision(config.trainer),
        max_epochs=1,
        logger=False,
        callbacks=[clock],
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        limit_val_batches=0,
    )
    trainer.fit(build_module(config, data), DataLoader([batch] * MOST, batch_size=None))  # type: ignore[arg-type]  # a list
    return clock.seconds


def _random_batch(source: Source, n: int, side: int) -> Batch:
    xyz = torch.tensor([0.0, 0.0, source.depth.z_centre]).expand(n, 3)
    image = torch.randint(0, 256, (n, side, side, 3), dtype=torch.uint8)
    return Batch(image, xyz, torch.full((n,), source.constant_f), float(side), torch.arange(n))

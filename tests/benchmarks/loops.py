"""A process that compares the programme's training with another loop around the same network.

`python loops.py LOOP FOLDER EPOCHS OVERRIDE...` alternates between both, epoch by epoch. For each epoch but the first
it prints a JSON line: images a second of the programme and of the loop, and the share of evaluation and logging in
the programme's epoch. LOOP is `bare`, and both train on noise in memory. With 0 EPOCHS it prints the peak memory in
bytes after two steps: of the bare loop, or of the programme if LOOP is `programme`.
"""

import copy
import json
import resource
import sys
import time
from pathlib import Path
from typing import Any

import torch
from lightning import Callback
from torch import Tensor

from phd_exp.cli.jobs import composed
from phd_exp.config import RunConfig, check
from phd_exp.data.batches import Batch
from phd_exp.data.datamodule import PositionData
from phd_exp.data.sources import Known, Part, Source
from phd_exp.geometry.charts import DepthScale
from phd_exp.hardware import precision
from phd_exp.records.dataset import CELLS
from phd_exp.records.runs import RunFolder
from phd_exp.training.build import build_module
from phd_exp.training.module import PositionModule
from phd_exp.training.recorder import Recorder
from phd_exp.training.run import UNTRAINED
from phd_exp.training.trainer import build_trainer


class Noise(Source):
    """As many samples of noise as a configuration asks for, of its size, with masks of noise."""

    def __init__(self, config: RunConfig) -> None:
        self.data = config.data
        zoom = config.data.image_size / 224
        self.depth = DepthScale.from_ranges((1200, 2000), (3, 5)).scaled(zoom)
        self.constant_f = 1550 * zoom

    def samples(self, part: Part) -> Batch:
        n, side = self.count(part), self.data.image_size
        random = torch.Generator().manual_seed(0)
        image = torch.randint(0, 256, (n, side, side, 3), dtype=torch.uint8, generator=random)
        xyz = torch.tensor([0.0, 0.0, 4.0]).expand(n, 3).clone()
        return Batch(image, xyz, torch.full((n,), self.constant_f), float(side), torch.arange(n))

    def known(self, part: Part) -> Known:
        return {}

    def count(self, part: Part) -> int:
        sizes = {"train": self.data.n_train, "held_out": 0, "test": self.data.n_test}
        return sizes[part] or 0

    def training_masks(self) -> Tensor:
        random = torch.Generator().manual_seed(0)
        return torch.randint(0, 256, (self.count("train"), CELLS, CELLS), dtype=torch.uint8, generator=random)


class Bare:
    """The loop of a tutorial: a batch, forward, backward, step; it measures and writes nothing."""

    def __init__(self, module: PositionModule, samples: Batch, config: RunConfig) -> None:
        self.regressor, self.loss = copy.deepcopy(module.regressor), module.loss
        self.optimizer = module.optimizer(self.regressor.parameters())
        self.samples, self.batch_size = samples, config.data.batch_size
        self.mixed = precision(config.trainer.accelerator, config.trainer.precision) == "bf16-mixed"

    def epoch(self) -> int:
        """Train on every sample once; returns the number of samples."""
        for rows in torch.randperm(len(self.samples)).split(self.batch_size):
            batch = self.samples.select(rows)
            with torch.autocast("cpu", enabled=self.mixed):
                loss = self.loss(self.regressor(batch.image, batch.camera), batch.xyz).mean()
            self.optimizer.zero_grad()
            loss.backward()
            self.optimizer.step()
        return len(self.samples)


class Alternating(Callback):
    """Times the programme's epochs, and an epoch of another loop after each."""

    def __init__(self, name: str, loop: Bare) -> None:
        self.name, self.loop = name, loop
        self.begin = self.trained = 0.0

    def on_train_epoch_start(self, *arguments: Any) -> None:
        self.begin = time.perf_counter()

    def on_train_batch_end(self, *arguments: Any) -> None:
        self.trained = time.perf_counter()

    def on_train_epoch_end(self, trainer: Any, pl_module: Any) -> None:
        end = time.perf_counter()
        n = self.loop.epoch()
        row = {
            "programme": n / (self.trained - self.begin),
            self.name: n / (time.perf_counter() - end),
            "evaluation": (end - self.trained) / (end - self.begin),
        }
        if trainer.current_epoch:  # the first one warms up
            print(json.dumps(row), flush=True)


class Memory(Callback):
    """Prints the peak memory after two batches and ends the process."""

    def on_train_batch_end(self, trainer: Any, *arguments: Any) -> None:
        if trainer.global_step == 2:
            print_peak_memory()
            sys.exit()


def print_peak_memory() -> None:
    print(1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, flush=True)


def main(kind: str, folder: Path, epochs: int, *overrides: str) -> None:
    words = ["logger=none", "trainer.progress_bar=false", *overrides]
    config = check(composed([*words, f"trainer.max_epochs={epochs}"] if epochs else words))
    data = PositionData(Noise(config), batch_size=config.data.batch_size, seed=0)
    data.setup()
    module = build_module(config, data)
    loop = Bare(module, data.samples["train"], config) if kind == "bare" else None
    if loop and not epochs:
        loop.epoch()
        loop.epoch()
        print_peak_memory()
        return
    folder.mkdir(parents=True, exist_ok=True)
    recorder = Recorder(RunFolder(folder), config.evaluation, None, [])
    recorder.record(UNTRAINED, {}, step=0)
    trainer = build_trainer(config, recorder)
    trainer.callbacks.append(Alternating(kind, loop) if loop else Memory())  # type: ignore[attr-defined]
    trainer.fit(module, datamodule=data)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]), *sys.argv[4:])

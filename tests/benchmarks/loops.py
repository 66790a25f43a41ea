"""A process that compares the programme's training with another loop around the same network.

`python loops.py LOOP FOLDER EPOCHS OVERRIDE...` alternates between both, epoch by epoch. For each epoch but the first
it prints a JSON line: images a second of the programme and of the loop, and the share of evaluation and logging in
the programme's epoch. LOOP is `bare`, on noise in memory, so that only training is measured, or `conventional`, on
rendered images. With 0 EPOCHS it prints the peak memory in bytes after two steps: of the bare loop, or of the
programme if LOOP is `programme`.
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
from PIL import Image
from torch import Tensor
from torch.utils.data import DataLoader, Dataset
from torchvision.transforms.functional import normalize, pil_to_tensor

from phd_exp.cli.jobs import composed
from phd_exp.config import RunConfig, check
from phd_exp.data.batches import Batch
from phd_exp.data.datamodule import PositionData
from phd_exp.data.sources import Known, Part, Source
from phd_exp.geometry.camera import Camera
from phd_exp.geometry.charts import DepthScale
from phd_exp.hardware import precision
from phd_exp.metrics.errors import depth_error, projected_error
from phd_exp.models.regressor import IMAGENET_MEAN, IMAGENET_STD
from phd_exp.records.dataset import CELLS, DatasetFolder
from phd_exp.records.runs import RunFolder
from phd_exp.training.build import build_data, build_module
from phd_exp.training.module import PositionModule
from phd_exp.training.recorder import Recorder
from phd_exp.training.run import UNTRAINED
from phd_exp.training.trainer import build_trainer

WORKERS = 2


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


class Pictures(Dataset[tuple[Tensor, Tensor, Tensor]]):
    """(pixels, position, focal length) of the first samples of a folder; each image is decoded from its file."""

    def __init__(self, folder: Path, labels: Batch) -> None:
        self.files = sorted(folder.glob("*.png"))[: len(labels)]
        self.labels, self.side = labels, int(labels.S)

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, i: int) -> tuple[Tensor, Tensor, Tensor]:
        picture = Image.open(self.files[i]).convert("RGB")
        if picture.width != self.side:
            picture = picture.resize((self.side, self.side), Image.Resampling.BOX)
        pixels = normalize(pil_to_tensor(picture) / 255, IMAGENET_MEAN, IMAGENET_STD)
        return pixels, self.labels.xyz[i], self.labels.f[i]


class Conventional:
    """The first loop of most projects, in float32 and torch's default memory format.

    The workers of a DataLoader decode images one by one, and the errors of every sample are collected in Python.
    """

    def __init__(self, module: PositionModule, labels: Batch, config: RunConfig) -> None:
        # contiguous whatever the programme chose, and the optimizer without its one kernel for all parameters
        self.regressor = copy.deepcopy(module.regressor).to(memory_format=torch.contiguous_format)
        self.loss, self.S = module.loss, labels.S
        self.optimizer = torch.optim.Adam(self.regressor.parameters(), lr=1e-3, foreach=False)
        pictures = Pictures(DatasetFolder(config.data.folder).split_folder("train"), labels)
        self.loader = DataLoader(
            pictures, config.data.batch_size, shuffle=True, num_workers=WORKERS, persistent_workers=True
        )

    def epoch(self) -> int:
        """Train on every sample once; returns the number of samples."""
        errors = []
        for pixels, xyz, f in self.loader:
            prediction = self.regressor.prediction(self.regressor.backbone(pixels), Camera(f, self.S))
            loss = self.loss(prediction, xyz).mean()
            self.optimizer.zero_grad()
            loss.backward()
            self.optimizer.step()
            for truth, estimate in zip(xyz, prediction.mode.detach(), strict=True):
                errors.append((projected_error(truth, estimate).item(), depth_error(truth, estimate).item()))
        return len(errors)


class Alternating(Callback):
    """Times the programme's epochs, and an epoch of another loop after each."""

    def __init__(self, name: str, loop: Bare | Conventional) -> None:
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
    noise = PositionData(Noise(config), batch_size=config.data.batch_size, seed=0)
    data = build_data(config) if kind == "conventional" else noise
    data.setup()
    module = build_module(config, data)
    loops = {"bare": Bare, "conventional": Conventional}
    loop = loops[kind](module, data.samples["train"], config) if kind in loops else None
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

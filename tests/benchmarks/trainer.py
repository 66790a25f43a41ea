"""A process that trains by the whole programme and, epoch by epoch between, by a bare loop of the same network.

`python trainer.py FOLDER EPOCHS OVERRIDE...` prints a JSON line for each epoch but the first: images a second of the
programme's training and of the bare loop, and the share of the programme's epoch that evaluation and logging take.
The images are noise and resident, so that nothing is measured but the training.
"""

import copy
import json
import sys
import time
from pathlib import Path

import hydra
import torch
from lightning import Callback, LightningModule, Trainer
from omegaconf import OmegaConf

from phd_exp.cli.paths import conf_folder
from phd_exp.data.batches import Batch
from phd_exp.data.datamodule import PositionData
from phd_exp.data.sources import Known, Part, Source
from phd_exp.geometry.charts import DepthScale
from phd_exp.records.runs import RunFolder
from phd_exp.training.build import build_calibration, build_module, build_trainer
from phd_exp.training.callbacks import RecordLogger
from phd_exp.training.config import RunConfig, check
from phd_exp.training.module import PositionModule


class Noise(Source):
    """As many samples as a configuration says, of its size; no picture of anything."""

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


class Bare:
    """The loop that every tutorial begins with: a batch, forward, backward, step; nothing is measured or written."""

    def __init__(self, module: PositionModule, samples: Batch, batch_size: int) -> None:
        self.regressor, self.loss = copy.deepcopy(module.regressor), module.loss
        self.optimizer = module.make_optimizer(self.regressor.parameters())
        self.samples = samples
        self.batch_size = batch_size

    def epoch(self) -> int:
        """Train on every sample once; how many there were."""
        for rows in torch.randperm(len(self.samples)).split(self.batch_size):
            batch = self.samples.select(rows)
            loss = self.loss(self.regressor(batch.image, batch.camera), batch.xyz)
            self.optimizer.zero_grad()
            loss.backward()
            self.optimizer.step()
        return len(self.samples)


class Alternating(Callback):
    """Times the programme's epochs, and a bare one after each."""

    def __init__(self, bare: Bare) -> None:
        self.bare = bare
        self.begin = self.trained = 0.0

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.begin = time.perf_counter()

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.trained = time.perf_counter()

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        end = time.perf_counter()
        n = self.bare.epoch()
        bare = n / (time.perf_counter() - end)
        if trainer.current_epoch:  # the first one warms up
            programme = n / (self.trained - self.begin)
            share = (end - self.trained) / (end - self.begin)
            print(json.dumps({"programme": programme, "bare": bare, "evaluation": share}), flush=True)


def main(folder: Path, epochs: int, overrides: list[str]) -> None:
    with hydra.initialize_config_dir(str(conf_folder()), version_base="1.3"):
        composed = hydra.compose(
            "config",
            ["logger=none", "trainer.progress_bar=false", f"trainer.max_epochs={epochs}", *overrides],
        )
    config = check(OmegaConf.to_container(composed, resolve=True))  # type: ignore[arg-type]
    data = PositionData(Noise(config), batch_size=config.data.batch_size, seed=0)
    data.setup()
    module = build_module(config, data)
    folder.mkdir(parents=True, exist_ok=True)
    run = RunFolder(folder)
    calibration = build_calibration(config, run, module, None, None)
    trainer = build_trainer(config, RecordLogger(run), [], calibration)
    bare = Bare(module, data.samples["train"], config.data.batch_size)
    trainer.callbacks.append(Alternating(bare))  # type: ignore[attr-defined]  # set by Lightning
    trainer.fit(module, datamodule=data)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3:])

"""A process that trains by the whole programme and, epoch by epoch between, by another loop with the same network.

`python trainer.py LOOP FOLDER EPOCHS OVERRIDE...` prints a JSON line for each epoch but the first: images a second by
the programme and by the loop, and the share of the programme's epoch that evaluation and logging take. LOOP is
`bare`, on resident noise, so that nothing is measured but the training, or `conventional`, on rendered images.
"""

import json
import sys
import time
from pathlib import Path
from typing import Any, Protocol

import hydra
from bare import Bare
from conventional import Conventional
from lightning import Callback, LightningModule, Trainer
from noise import Noise
from omegaconf import OmegaConf

from phd_exp.cli import conf_folder
from phd_exp.data.datamodule import PositionData
from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.runs import RunFolder
from phd_exp.training.build import build_data, build_module, build_trainer
from phd_exp.training.config import RunConfig, check
from phd_exp.training.module import PositionModule
from phd_exp.training.recorder import Recorder


class Loop(Protocol):
    """Another way to train the same network."""

    name: str

    def epoch(self) -> int:
        """Train on every sample once; how many there were."""


class Alternating(Callback):
    """Times the programme's epochs, and one of another loop after each."""

    def __init__(self, loop: Loop) -> None:
        self.loop = loop
        self.begin = self.trained = 0.0

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.begin = time.perf_counter()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        self.trained = time.perf_counter()

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        end = time.perf_counter()
        n = self.loop.epoch()
        speed = n / (time.perf_counter() - end)
        if trainer.current_epoch:  # the first one warms up
            programme = n / (self.trained - self.begin)
            share = (end - self.trained) / (end - self.begin)
            print(
                json.dumps({"programme": programme, self.loop.name: speed, "evaluation": share}), flush=True
            )


def configured(*overrides: str) -> RunConfig:
    with hydra.initialize_config_dir(str(conf_folder()), version_base="1.3"):
        composed = hydra.compose("config", ["logger=none", "trainer.progress_bar=false", *overrides])
    return check(OmegaConf.to_container(composed, resolve=True))  # type: ignore[arg-type]


def main(kind: str, folder: Path, epochs: int, overrides: list[str]) -> None:
    config = configured(f"trainer.max_epochs={epochs}", *overrides)
    noise = PositionData(Noise(config), batch_size=config.data.batch_size, seed=0)
    data = noise if kind == "bare" else build_data(config)
    data.setup()
    module = build_module(config, data)
    folder.mkdir(parents=True, exist_ok=True)
    run = RunFolder(folder)
    trainer = build_trainer(config, Recorder(run, config.evaluation, None, []))
    trainer.callbacks.append(Alternating(rival(kind, module, data, config)))  # type: ignore[attr-defined]
    trainer.fit(module, datamodule=data)


def rival(kind: str, module: PositionModule, data: PositionData, config: RunConfig) -> Loop:
    samples = data.samples["train"]
    if kind == "bare":
        return Bare(module, samples, config)
    pictures = DatasetFolder(config.data.folder).split_folder("train")
    return Conventional(module, pictures, samples, config.data.batch_size)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]), sys.argv[4:])

"""Images a second on a GPU at `preset=paper`, which `make gpu` prints.

Each recipe is trained on noise in memory, first with its own data path, then with one batch repeated. The difference
of both times is the wait for data. Prints a JSON line for each recipe. It runs on a CPU too, for a check.
"""

import argparse
import itertools
import json
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from loops import Noise
from torch.utils.data import IterableDataset

from phd_exp.cli.jobs import composed
from phd_exp.config import RunConfig, check
from phd_exp.data.batches import Batch
from phd_exp.data.datamodule import PositionData
from phd_exp.records.processes import machine
from phd_exp.records.runs import RunFolder
from phd_exp.training.build import build_augmentation, build_module
from phd_exp.training.recorder import Recorder
from phd_exp.training.run import UNTRAINED, quiet_lightning
from phd_exp.training.trainer import build_trainer

RECIPES = {
    "paper": ["recipe=paper"],
    "strong": ["recipe=strong"],
    "strong, robust": ["recipe=strong", "photometry=robust"],
}
WARM_UP = 10  # steps


class Batches(IterableDataset[Batch]):
    """A loader of batches, without their end."""

    def __init__(self, loader: Iterable[Batch]) -> None:
        self.loader = loader

    def __iter__(self) -> Any:
        while True:
            yield from self.loader


class Clock(Callback):
    """The seconds from the end of the warm-up to the end of the training."""

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if batch_idx + 1 == WARM_UP:
            self.begun = now(pl_module.device)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.seconds = now(pl_module.device) - self.begun


def now(device: torch.device) -> float:
    """The time at which all work so far is done."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def seconds(config: RunConfig, data: PositionData, loader: Iterable[Batch], steps: int) -> float:
    """The time of `steps` training steps."""
    clock = Clock()
    with tempfile.TemporaryDirectory() as folder:
        recorder = Recorder(RunFolder(Path(folder)), config.evaluation, None, [])
        recorder.record(UNTRAINED, {}, step=0)
        trainer = build_trainer(config, recorder, [clock])
        trainer.limit_train_batches, trainer.limit_val_batches = WARM_UP + steps, 0
        trainer.fit(build_module(config, data), Batches(loader))
    return clock.seconds


def measured(overrides: list[str], steps: int) -> dict[str, Any]:
    """Images a second of a recipe, with its data path and without."""
    quiet_lightning()
    settings = ["logger=none", "trainer.progress_bar=false", "trainer.max_epochs=1", "data.n_train=640"]
    config = check(composed(["preset=paper", *settings, *overrides]))
    data = PositionData(
        Noise(config),
        batch_size=config.data.batch_size,
        augment=build_augmentation(config.recipe),
        masks=config.recipe.segmentation > 0,
    )
    data.setup()
    data.move_to(torch.device("cuda", 0) if torch.cuda.is_available() else torch.device("cpu"))
    batch = next(iter(data.train_dataloader()))
    whole = seconds(config, data, data.train_dataloader(), steps)
    alone = seconds(config, data, itertools.repeat(batch), steps)
    n = steps * config.data.batch_size
    return {"images_per_s": round(n / whole), "without_data": round(n / alone), "wait": round(1 - alone / whole, 3)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=100, help="training steps that are timed")
    parser.add_argument("--recipes", nargs="+", choices=list(RECIPES), default=list(RECIPES))
    parser.add_argument("overrides", nargs="*", help="of the configuration, such as data.image_size=64")
    arguments = parser.parse_intermixed_args()
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "no GPU"
    print(json.dumps({"machine": machine(), "gpu": gpu, "torch": torch.__version__}), flush=True)
    for name in arguments.recipes:
        found = measured([*RECIPES[name], *arguments.overrides], arguments.steps)
        print(json.dumps({"recipe": name} | found), flush=True)


if __name__ == "__main__":
    main()

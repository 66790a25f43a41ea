"""How much memory training takes at most: `python memory.py LOOP FOLDER OVERRIDE...` prints it in bytes.

LOOP is `bare`, two steps of a bare loop, or `programme`, two batches of the whole programme.
"""

import resource
import sys
from pathlib import Path
from typing import Any

from bare import Bare
from lightning import Callback, LightningModule, Trainer
from noise import Noise
from trainer import configured

from phd_exp.data.datamodule import PositionData
from phd_exp.records.runs import RunFolder
from phd_exp.training.build import build_module, build_trainer
from phd_exp.training.recorder import Recorder


class Enough(Callback):
    """Ends a training after two batches, without its validation."""

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *arguments: Any) -> None:
        if trainer.global_step == 2:
            print(peak(), flush=True)
            sys.exit()


def peak() -> int:
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def main(kind: str, folder: Path, overrides: list[str]) -> None:
    config = configured(*overrides)
    data = PositionData(Noise(config), batch_size=config.data.batch_size, seed=0)
    data.setup()
    module = build_module(config, data)
    if kind == "bare":
        loop = Bare(module, data.samples["train"], config)
        loop.epoch()
        loop.epoch()
        print(peak())
        return
    run = RunFolder(folder)
    trainer = build_trainer(config, Recorder(run, config.evaluation, None, []))
    trainer.callbacks.append(Enough())  # type: ignore[attr-defined]  # set by Lightning
    trainer.fit(module, datamodule=data)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), sys.argv[3:])

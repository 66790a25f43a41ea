"""Weights & Biases beside the run record: one run of theirs for each of ours, ended as ours ended."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import wandb
from lightning.pytorch.loggers import Logger, WandbLogger

from phd_exp.records.runs import RunFolder
from phd_exp.training.config import RunConfig


@contextmanager
def tracked(config: RunConfig, folder: RunFolder) -> Iterator[list[Logger]]:
    """The loggers that a run is sent to besides its own record; what they began is finished, or failed, at the end.

    Left unfinished, a wandb run would take in whatever the next run of a sweep logs.
    """
    if config.logger.kind == "none":
        yield []
        return
    run = _begin(config, folder)
    try:
        yield [WandbLogger(experiment=run)]
    except BaseException:
        run.finish(exit_code=1)
        raise
    run.finish()


def _begin(config: RunConfig, folder: RunFolder) -> wandb.Run:
    if config.logger.offline:
        os.environ["WANDB_ERROR_REPORTING"] = "false"  # the one thing that would look up a host
    return wandb.init(
        project=config.logger.project,
        name="/".join(folder.path.parts[-4:]),
        dir=folder.path,
        mode="offline" if config.logger.offline else "online",
        config=config.model_dump(mode="json"),
        settings=wandb.Settings(silent=True, console="off"),  # the terminal is ours, and so is its end
    )

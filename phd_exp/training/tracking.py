"""Weights & Biases: one wandb run per run, with the same outcome."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import wandb
from lightning.pytorch.loggers import WandbLogger

from phd_exp.records.errors import ConfigError
from phd_exp.records.runs import RunFolder
from phd_exp.training.config import RunConfig
from phd_exp.training.config.sections import LoggerConfig


def require_key(logger: LoggerConfig) -> None:
    """Raise ConfigError if an online run has no API key; on a terminal wandb asks for one."""
    if logger.kind == "none" or logger.offline:
        return
    try:
        wandb.login()
    except wandb.errors.UsageError:
        raise ConfigError(
            "logger.offline: got false, but wandb has no API key; run `wandb login`, or keep logger.offline=true"
        ) from None


@contextmanager
def tracked(config: RunConfig, folder: RunFolder) -> Iterator[WandbLogger | None]:
    """The logger of a run, or None. On exit its wandb run is finished, as failed after an exception.

    An unfinished wandb run would receive the metrics of the next run of a sweep.
    """
    if config.logger.kind == "none":
        yield None
        return
    with _everything_in(folder.wandb):
        run = _begin(config, folder)  # as a context it would print a traceback
        try:
            yield WandbLogger(experiment=run)
        except BaseException:
            run.finish(exit_code=1)
            raise
        run.finish()


@contextmanager
def _everything_in(place: Path) -> Iterator[None]:
    """Make wandb write its logs and caches to `place` instead of the home folder.

    The wandb service reads these variables when it starts, so each run starts and stops one.
    """
    set_here = [name for name in ("WANDB_DATA_DIR", "WANDB_CACHE_DIR") if name not in os.environ]
    os.environ.update(dict.fromkeys(set_here, str(place.absolute())))
    try:
        yield
    finally:
        wandb.teardown()
        for name in set_here:
            del os.environ[name]


def _begin(config: RunConfig, folder: RunFolder) -> wandb.Run:
    if config.logger.offline:
        os.environ["WANDB_ERROR_REPORTING"] = "false"  # it uses the network
        # of an interrupted run, whose recorded epochs are sent again
        shutil.rmtree(folder.wandb, ignore_errors=True)
    return wandb.init(
        project=config.logger.project,
        name="/".join(folder.path.parts[-4:]),
        dir=folder.path.absolute(),  # the service may have another working folder
        mode="offline" if config.logger.offline else "online",
        config=config.model_dump(mode="json"),
        settings=wandb.Settings(silent=True, console="off"),
    )

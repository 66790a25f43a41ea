"""Lightning's loggers, fed from the run record. Each writes to a folder of its name below the run."""

import inspect
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

from lightning.pytorch.loggers import Logger, WandbLogger

from phd_exp.build import naming
from phd_exp.config.targets import build, locate
from phd_exp.records.choices import flatten
from phd_exp.records.errors import ConfigError
from phd_exp.records.runs import RunFolder

WANDB = "lightning.pytorch.loggers.WandbLogger"


def require_possible_loggers(loggers: Mapping[str, Any]) -> None:
    """Raise ConfigError if a logger cannot be imported, or wandb has no key; on a terminal wandb asks for one."""
    for name, node in loggers.items():
        if node["_target_"] != WANDB:
            with naming(f"logger.{name}", node):
                build(node, is_partial=True)
        elif not node.get("offline"):
            import wandb

            try:
                wandb.login()
            except wandb.errors.UsageError:
                raise ConfigError(
                    f"logger.{name}.offline: got false, but wandb has no API key; run `wandb login`, or keep it true"
                ) from None


@contextmanager
def tracked(nodes: Mapping[str, Any], config: dict[str, Any], folder: RunFolder) -> Iterator[list[Logger]]:
    """The loggers of a run, which receive its configuration; finished on exit, as failed after an exception.

    What an interrupted run has sent to their folders is removed: the record sends it again.
    """
    with ExitStack() as stack:
        loggers = []
        for name, node in nodes.items():
            shutil.rmtree(folder.path / name, ignore_errors=True)
            begin = _wandb if node["_target_"] == WANDB else _logger
            loggers.append(begin(name, node, config, folder, stack))
        yield loggers


def _logger(name: str, node: dict[str, Any], config: dict[str, Any], folder: RunFolder, stack: ExitStack) -> Logger:
    os.environ.setdefault("MLFLOW_ALLOW_FILE_STORE", "true")  # files need no database, and outlive MLflow
    with naming(f"logger.{name}", node):
        takes_folder = "save_dir" in inspect.signature(locate(node["_target_"], None)).parameters
        place = {"save_dir": str(folder.path.absolute() / name)} if takes_folder else {}
        logger = build(place | node)
        if not isinstance(logger, Logger):
            raise ValueError(f"makes a {type(logger).__name__}; expected a Logger of Lightning")
        logger.log_hyperparams(flatten(config))

    def finish(kind: object, *error: object) -> None:
        logger.finalize("failed" if kind else "success")

    stack.push(finish)
    return logger


def _wandb(name: str, node: dict[str, Any], config: dict[str, Any], folder: RunFolder, stack: ExitStack) -> Logger:
    """A run of wandb; an unfinished one would receive the metrics of the next run of a sweep."""
    import wandb

    arguments = {key: value for key, value in node.items() if key not in ("_target_", "offline")}
    # else the service would write to the home folder; it reads them when it starts, so each run starts and stops one
    place = str((folder.path / name).absolute())
    for variable in {"WANDB_DATA_DIR", "WANDB_CACHE_DIR"} - os.environ.keys():
        os.environ[variable] = place
        stack.callback(os.environ.pop, variable)
    stack.callback(wandb.teardown)
    if node.get("offline"):
        os.environ["WANDB_ERROR_REPORTING"] = "false"  # it uses the network
    run = wandb.init(  # as a context it would print a traceback
        name="/".join(folder.names),
        dir=folder.path.absolute(),  # the service may have another working folder
        mode="offline" if node.get("offline") else "online",
        config=config,
        settings=wandb.Settings(silent=True, console="off"),
        **arguments,
    )
    stack.push(lambda kind, *_: run.finish(exit_code=1 if kind else 0))
    return WandbLogger(experiment=run)


def send_results(loggers: Sequence[Logger], results: Mapping[str, Any]) -> None:
    """Put the final numbers into the summary of wandb; the other loggers have none."""
    for logger in loggers:
        if isinstance(logger, WandbLogger):
            logger.experiment.summary.update(results)

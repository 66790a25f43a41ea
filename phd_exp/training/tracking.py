"""Weights & Biases beside the run record: one run of theirs for each of ours, ended as ours ended."""

import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import wandb
from lightning.pytorch.loggers import WandbLogger
from wandb.sdk.artifacts.artifact_instance_cache import (
    artifact_instance_cache_by_client_id as tables_of_wandb,
)

from phd_exp.records.runs import RunFolder, epoch_name
from phd_exp.training.config import RunConfig


@contextmanager
def tracked(config: RunConfig, folder: RunFolder) -> Iterator["Tracker | None"]:
    """What a run is sent to besides its own record; what was begun there is finished, or failed, at the end.

    Left unfinished, a wandb run would take in whatever the next run of a sweep logs.
    """
    if config.logger.kind == "none":
        yield None
        return
    with _everything_in(folder.wandb):
        run = _begin(config, folder)
        try:
            yield Tracker(run, folder)
        except BaseException:
            run.finish(exit_code=1)
            raise
        run.finish()


class Tracker:
    """One run of wandb.

    Args:
        run: theirs, begun.
        folder: ours.
    """

    def __init__(self, run: wandb.Run, folder: RunFolder) -> None:
        self.run = run
        self.folder = folder
        self.logger = WandbLogger(experiment=run)

    def send_epochs(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Send the epochs of the record that were trained before this process began, with their curves."""
        for row in rows:
            values = {key: value for key, value in row.items() if key != "step" and value is not None}
            self.logger.log_metrics(values, step=row["step"])
            if self.folder.curves(name := epoch_name(row["epoch"])).exists():
                self.send_calibration(name, row["step"])

    def send_calibration(self, name: str, step: int) -> None:
        """Send calibration curves of the record, as a table and, where they are drawn, as a picture."""
        points = [
            [name, *point]
            for name, curve in json.loads(self.folder.curves(name).read_text()).items()
            for point in zip(curve["predicted"], curve["empirical"], strict=True)
        ]
        header = ["curve", "predicted", "empirical"]
        self.logger.log_table("test/calibration_curves", header, points, step=step)
        picture = self.folder.curves(name).with_suffix(".png")
        if picture.exists():
            self.logger.log_image("test/calibration", [str(picture)], step=step)

    def send_results(self, results: Mapping[str, Any]) -> None:
        """Let the final numbers stand in the summary of the run."""
        self.run.summary.update(dict(results))


@contextmanager
def _everything_in(place: Path) -> Iterator[None]:
    """Have wandb keep in `place` what it would leave at home: tables that `wandb sync` sends, logs of its service.

    The service is told when it starts. So each run has one of its own, which is ended, and what it holds in memory.
    """
    told = [name for name in ("WANDB_DATA_DIR", "WANDB_CACHE_DIR") if name not in os.environ]
    os.environ.update(dict.fromkeys(told, str(place.absolute())))
    try:
        yield
    finally:
        wandb.teardown()
        _remove_temporary_tables()
        for name in told:
            del os.environ[name]


def _remove_temporary_tables() -> None:
    """Remove the files from which wandb copied its tables; it would keep the last hundred till the process ends."""
    for table in tables_of_wandb.values():
        if table._tmp_dir is not None:
            table._tmp_dir.cleanup()
    tables_of_wandb.clear()


def _begin(config: RunConfig, folder: RunFolder) -> wandb.Run:
    if config.logger.offline:
        os.environ["WANDB_ERROR_REPORTING"] = "false"  # the one thing that would look up a host
        # what a broken-off run left is half a run; the record holds its epochs, and they are sent again
        shutil.rmtree(folder.wandb, ignore_errors=True)
    return wandb.init(
        project=config.logger.project,
        name="/".join(folder.path.parts[-4:]),
        dir=folder.path.absolute(),  # the service that writes there may have been started elsewhere
        mode="offline" if config.logger.offline else "online",
        config=config.model_dump(mode="json"),
        settings=wandb.Settings(silent=True, console="off"),  # the terminal is ours, and so is its end
    )

"""What the jobs of one launch tell their launcher, wherever they run: a small file for each begun and each ended.

A launcher may run jobs in this process, in others, or on other machines. A job holds a lock while it runs, which
the system drops however it dies: so a job that ended without a word is told from one that still runs.
"""

import fcntl
import shutil
import traceback
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import BaseModel

from phd_exp.cli.signals import Stopped, ending_with, stopping_on_signals
from phd_exp.records.errors import ConfigError, RunError, UserError
from phd_exp.records.files import write_atomic
from phd_exp.records.provenance import usable_cores

BAD_CONFIGURATION = 2
FAILED = 1
HOME = uuid.uuid4().hex
"""This process: another one that imports this module has another."""

Task = Callable[[dict[str, Any], list[str], int], str]
"""Takes the resolved configuration, the overrides that led to it, and how many cores it may use.

Returns, if it ends well, its state in a word or two.
"""


class Ending(BaseModel):
    """How a job ended: what was asked for, its state, the exit status, and what is wrong, one thing a line."""

    overrides: list[str]
    state: str = "failed"
    exit_status: int = 0
    lines: list[str] = []

    @classmethod
    def of(cls, overrides: list[str], error: BaseException) -> "Ending":
        """The ending of a job that this error stopped."""
        if isinstance(error, Stopped):
            line = f"stopped by {error}; the same command goes on from here"
            return cls(overrides=overrides, state="stopped", exit_status=int(str(error.code)), lines=[line])
        if isinstance(error, UserError):
            status = BAD_CONFIGURATION if isinstance(error, ConfigError) else FAILED
            return cls(overrides=overrides, exit_status=status, lines=str(error).splitlines())
        line = f"{type(error).__name__}: {' '.join(str(error).split())}"
        return cls(overrides=overrides, exit_status=FAILED, lines=[line])


@dataclass(frozen=True)
class JobRecords:
    """The folder of one launch; every machine that runs a job sees it."""

    path: Path

    @classmethod
    def begin(cls, path: Path) -> "JobRecords":
        """A new folder. Raises RunError where it cannot be written."""
        try:
            path.mkdir(parents=True)
        except OSError as error:
            raise RunError(
                f"{path}: cannot be written ({error.strerror}); choose another runs=DIR"
            ) from error
        return cls(path)

    @contextmanager
    def running(self, number: int) -> Iterator[None]:
        """Mark a job as begun, and as alive while the body runs."""
        with open(self.path / f"{number}.begun", "a+b") as stream:
            fcntl.flock(stream, fcntl.LOCK_SH)  # shared: a queue may give one job several processes
            yield

    def end(self, number: int, ending: Ending) -> None:
        """Record how a job ended."""
        write_atomic(self.path / f"{number}.json", ending.model_dump_json() + "\n")

    def ending(self, number: int, overrides: list[str]) -> Ending:
        """How a job ended; waits for one that still runs."""
        begun, ended = self.path / f"{number}.begun", self.path / f"{number}.json"
        if begun.exists():
            with open(begun, "a+b") as stream:
                fcntl.flock(stream, fcntl.LOCK_EX)
        if ended.exists():
            return Ending.model_validate_json(ended.read_bytes())
        reason = (
            "ended without a word: it was killed, or memory ran out; the same command goes on from there"
            if begun.exists()
            else "did not start before its launcher gave up; give the same command again"
        )
        return Ending(overrides=overrides, exit_status=FAILED, lines=[reason])

    def remove(self) -> None:
        """Delete the folder; nothing is said where that cannot be."""
        shutil.rmtree(self.path, ignore_errors=True)


@dataclass(frozen=True)
class Launch:
    """What all jobs of one launch are told, wherever they run.

    Attributes:
        records: where they say how they ended.
        cores: how many each may use; None: all that its process may use.
        parent: the process whose children they are and with which they end; None: they outlive the launcher.
        home: the launcher's own process.
    """

    records: JobRecords
    cores: int | None = None
    parent: int | None = None
    home: str = HOME

    def function(self, task: Task) -> Callable[[DictConfig], None]:
        """The task as Hydra calls it; a launcher may pickle this function with what it holds."""

        def job(config: DictConfig) -> None:
            run_job(task, self, config)

        return job


def run_job(task: Task, launch: Launch, config: DictConfig) -> None:
    """Run one job and record how it ended; a failure is recorded and not raised, so that a sweep goes on.

    A stop goes up in the launcher's own process, where it ends everything. In another process it ends that job.
    """
    hydra = HydraConfig.get()
    overrides = OmegaConf.to_container(hydra.overrides.task)
    assert isinstance(overrides, list)
    number = 0 if OmegaConf.is_missing(hydra.job, "num") else hydra.job.num  # a single run has none
    at_home = launch.home == HOME
    with launch.records.running(number):
        try:
            # hydra's launchers put signal handlers of their own into their processes, or none
            with stopping_on_signals(), ending_with(None if at_home else launch.parent):
                # as they read once interpolations are resolved: what they say has its part in the run's name
                state = task(plain(config), list(hydra.overrides.task), launch.cores or usable_cores())
            ending = Ending(overrides=overrides, state=state)
        except Stopped as stop:
            if at_home:
                raise
            ending = Ending.of(overrides, stop)
        except OmegaConfBaseException as error:  # an interpolation that leads nowhere
            ending = Ending.of(overrides, ConfigError(" ".join(str(error).split())))
        except Exception as error:
            if not isinstance(error, UserError):
                traceback.print_exc()  # a fault of the programme, not of its user
            ending = Ending.of(overrides, error)
        launch.records.end(number, ending)


def plain(config: DictConfig) -> dict[str, Any]:
    """The configuration as plain containers, every interpolation resolved; what is missing is left for the check."""
    values = _without_missing(OmegaConf.to_container(config, resolve=True))
    return {str(key): value for key, value in values.items()}


def _without_missing(node: Any) -> Any:
    if not isinstance(node, dict):
        return node
    return {key: _without_missing(value) for key, value in node.items() if value != MISSING}

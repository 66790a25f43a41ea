"""A job: the task of a verb as Hydra, its launchers and its sweepers call it."""

import uuid
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from phd_exp.cli.frame import Ending, failure, print_errors
from phd_exp.cli.signals import Stopped, ending_with, stopping_on_signals
from phd_exp.records.errors import ConfigError, RunError
from phd_exp.records.processes import usable_cores

HOME = uuid.uuid4().hex
"""This process: another one that imports this module has another."""

Task = Callable[[dict[str, Any], list[str], int], float | None]
"""Takes the resolved configuration, its overrides and the number of cores it may use; returns its score, if any."""
Standing = Callable[[dict[str, Any], list[str]], str | None]
"""How the job of a configuration, given its overrides, stands on disk: "finished", "running" in some process, what
ended it otherwise, or None if nothing is recorded.
"""


@dataclass(frozen=True)
class Job:
    """A verb as Hydra and its launchers call it; a launcher may pickle it and run it on another machine.

    Attributes:
        task: what a job does.
        standing: how a job stands on disk; None if the verb records nothing.
        endings: of all jobs, in the launcher's own process.
        n_jobs: how many jobs the sweep has.
        cores: how many each may use; None: all that its process may use.
        parent: the process with which a job ends; None: jobs outlive the launcher.
        home: the launcher's own process.
    """

    task: Task
    standing: Standing | None = None
    endings: list[Ending] = field(default_factory=list)
    n_jobs: int = 1
    cores: int | None = None
    parent: int | None = None
    home: str = HOME

    def __call__(self, config: DictConfig) -> float | None:
        """Run the job; a single run keeps its ending, a sweeper of others gets the score or an error."""
        ending = self.end(config)
        if HydraConfig.get().mode == RunMode.RUN:
            print_errors(ending.lines)
            self.endings.append(ending)
        elif ending.exit_status:
            raise RunError("\n".join(ending.lines))
        return ending.value

    def end(self, config: DictConfig) -> Ending:
        """Run the job and say how it ended. A stop ends everything in the launcher's own process, else this job."""
        at_home = self.home == HOME
        try:
            # launchers install signal handlers of their own, or none
            with stopping_on_signals(), ending_with(None if at_home else self.parent):
                return Ending("finished", value=self._run(config))
        except Stopped as stop:
            if at_home:
                raise
            return failure(stop)
        except OmegaConfBaseException as error:  # an interpolation that leads nowhere
            return refusal(ConfigError(" ".join(str(error).split())))
        except ConfigError as error:
            return refusal(error)
        except Exception as error:
            return failure(error)

    def _run(self, config: DictConfig) -> float | None:
        composed = HydraConfig.get()
        # as they read once interpolations are resolved: their values are part of the run's name
        overrides = list(composed.overrides.task)
        if composed.mode == RunMode.MULTIRUN:
            print(f"job {composed.job.num + 1}/{self.n_jobs}: {' '.join(overrides)}", flush=True)
        elif experiment := composed.runtime.choices.get("experiment"):
            words = " ".join(map(str, overrides))
            raise ConfigError(f"experiment={experiment}: names several runs; write -m before it: -m {words}")
        return self.task(plain(config), overrides, self.cores or usable_cores())


def refusal(error: ConfigError) -> Ending:
    """The ending of what a wrong configuration keeps from running."""
    return failure(error)._replace(exit_status=2)


def plain(config: DictConfig) -> dict[str, Any]:
    """The configuration as plain containers, interpolations resolved; missing values are left out for the check."""
    values = _without_missing(OmegaConf.to_container(config, resolve=True))
    return {str(key): value for key, value in values.items()}


def _without_missing(node: Any) -> Any:
    if not isinstance(node, dict):
        return node
    return {key: _without_missing(value) for key, value in node.items() if value != MISSING}

"""Hydra for the verbs `train` and `render`: a job, and its launch, once or with -m as a sweep."""

import os
import shlex
import sys
import uuid
from argparse import ArgumentParser
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from phd_exp.cli import conf_folder, words
from phd_exp.cli.frame import Ending, Stopped, ending_with, failure, print_errors, stopping_on_signals
from phd_exp.cli.words import REFUSED, SHARED, explain, in_conf, parsed
from phd_exp.records.errors import ConfigError, RunError
from phd_exp.records.processes import usable_cores

OMP = "OMP_NUM_THREADS"
NO_SCORE = "the sweeper receives no score: only trainings with held-out samples have one; set data.n_held_out above 0"
THIS_PROCESS = uuid.uuid4().hex  # names this process: another process that imports this module has another value
FLAGS = ("--multirun -m", "--run -r", "--resolve", "--hydra-help", "--shell-completion -sc")
WITH_VALUES = ("--package -p", "--config-path -cp", "--config-name -cn", "--config-dir -cd", "--cfg -c")
"""Options of Hydra, long and short."""


@dataclass(frozen=True)
class Job:
    """A task that Hydra calls. A launcher may pickle it and run it on another machine.

    Attributes:
        task: takes the resolved configuration, its overrides and the number of cores; returns the score, if any.
        standing: the state on disk of the job with a configuration and overrides: "finished", "running" (in any
            process), the error that ended it, or None without a record. None if the verb records nothing.
        numbers: the results on disk of the finished job with a configuration and overrides, in words. None if the
            verb has none.
        endings: of all jobs, in the launcher's own process.
        n_jobs: the number of jobs of the sweep.
        cores: the number of cores for each; None: all that its process may use.
        parent: the process with which a job ends; None: jobs outlive the launcher.
        home: the launcher's own process.
        omp: the OMP_NUM_THREADS of the launcher's own process.
    """

    task: Callable[[dict[str, Any], list[str], int], float | None]
    standing: Callable[[dict[str, Any], list[str]], str | None] | None = None
    numbers: Callable[[dict[str, Any], list[str]], str] | None = None
    endings: list[Ending] = field(default_factory=list)
    n_jobs: int = 1
    cores: int | None = None
    parent: int | None = None
    home: str = THIS_PROCESS
    omp: str | None = field(default_factory=lambda: os.environ.get(OMP))

    def __call__(self, config: DictConfig) -> float | None:
        """Run the job. A single run keeps its ending; other sweepers than ours get the score or an error."""
        ending = self.end(config)
        if HydraConfig.get().mode == RunMode.RUN:
            print_errors(ending.lines)
            self.endings.append(ending)
        elif ending.exit_status:
            raise RunError("\n".join(ending.lines))
        elif ending.value is None:
            print(NO_SCORE, flush=True)
        return ending.value

    def end(self, config: DictConfig) -> Ending:
        """Run the job; returns how it ended. In the launcher's own process, a signal stops the whole sweep."""
        at_home = self.home == THIS_PROCESS
        try:
            # a launcher may have changed the signal handlers
            with stopping_on_signals(), ending_with(None if at_home else self.parent):
                return Ending("finished", value=self._run(config))
        except Stopped as stop:
            if at_home:
                raise
            return failure(stop)
        except OmegaConfBaseException as error:  # an interpolation of an unknown key
            return failure(explain(error))
        except Exception as error:
            return failure(error)

    def _run(self, config: DictConfig) -> float | None:
        composed = HydraConfig.get()
        if self.cores:  # the share of this job; launchers set the variable by another rule
            os.environ.pop(OMP, None) if self.omp is None else os.environ.update({OMP: self.omp})
        # with interpolations resolved: the values are part of the run's name
        overrides = list(composed.overrides.task)
        if composed.mode == RunMode.MULTIRUN:
            print(f"job {composed.job.num + 1}/{self.n_jobs}: {' '.join(overrides)}", flush=True)
        elif experiment := composed.runtime.choices.get("experiment"):
            command = shlex.join(map(str, overrides))
            raise ConfigError(f"experiment={experiment}: names several runs; write -m before it: -m {command}")
        return self.task(plain(config), overrides, self.cores or usable_cores())


def plain(config: DictConfig) -> dict[str, Any]:
    """The configuration as plain containers: interpolations resolved, without missing values and `SHARED`."""

    def without_missing(node: Any) -> Any:
        if not isinstance(node, dict):
            return node
        return {str(key): without_missing(value) for key, value in node.items() if value != MISSING}

    values = without_missing(OmegaConf.to_container(config, resolve=True))
    return {key: value for key, value in values.items() if key not in SHARED}


def composed(
    overrides: Iterable[str], config_dir: str | Path | None = None, config_name: str = "config"
) -> dict[str, Any]:
    """The configuration of one run, without Hydra's command line. Raises ConfigError for a bad override."""
    search = [f"hydra.searchpath=[file://{Path(config_dir).absolute()}]"] if config_dir else []
    try:
        with in_conf():
            return plain(hydra.compose(config_name, [*overrides, *search]))
    except REFUSED as error:
        raise explain(error, config_name) from None


def launch(job: Job, line: list[str], config_name: str = "config") -> int:
    """Run a job through Hydra, once or (-m) for every combination; returns the exit status.

    `line` are the words after the verb; they change the configuration in `conf/<config_name>.yaml`. Raises RunError
    if a launcher fails.
    """
    # Hydra would print errors over several lines, and exit
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        sys.argv = [sys.argv[0], *_options_last(line)]
        hydra.main(version_base="1.3", config_path=str(conf_folder()), config_name=config_name)(job)()
    except (*REFUSED, ConfigError) as error:
        job.endings.append(failure(explain(error, config_name)))
        print_errors(job.endings[-1].lines)
    return max((ending.exit_status for ending in job.endings), default=0)


def _options_last(line: list[str]) -> list[str]:
    """The words with paths quoted, and Hydra's options after the overrides; its parser wants these in one piece.

    Raises ConfigError instead of the parser's usage message of several lines.
    """

    def refuse(message: str) -> NoReturn:
        raise ConfigError(f"{message}; see `python -m phd_exp --help`")

    parser = ArgumentParser(add_help=False, allow_abbrev=False)
    parser.error = refuse  # type: ignore[method-assign]
    parser.add_argument("overrides", nargs="*")
    parser.add_argument("--info", "-i", nargs="?")
    for names in FLAGS:
        parser.add_argument(*names.split(), action="store_true")
    for names in WITH_VALUES:
        parser.add_argument(*names.split(), choices=["job", "hydra", "all"] if "--cfg" in names else None)
    arguments = parser.parse_intermixed_args(line)
    options = [word for word in line if word not in arguments.overrides]
    overrides = words.overrides(arguments.overrides, several=arguments.multirun)
    if arguments.multirun and any(word.startswith("experiment=") for word in overrides):
        overrides = list(map(_for_jobs_alone, overrides))
    return [*overrides, *options]


def _for_jobs_alone(word: str) -> str:
    """A key's override as a choice of one value, which Hydra applies to jobs alone.

    Before, Hydra composes a configuration without the choices of the experiment, which may lack the key.
    """
    key, _, value = word.partition("=")
    if "." not in key or key.startswith(("hydra.", "~")) or parsed(word).is_sweep_override():
        return word
    try:
        return str(parsed(f"{key}=choice({value})").input_line)
    except HydraException:  # no value, or a mistake, which is reported with the others
        return word

"""A sweep: what its jobs are, known before any begins; who runs them; how all of them ended."""

import json
import os
import uuid
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra
from hydra._internal.callbacks import Callbacks
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, RangeSweep
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from phd_exp.cli.cores import cores_a_job
from phd_exp.cli.jobs import Ending, JobRecords, Launch, Task, plain
from phd_exp.cli.paths import conf_folder
from phd_exp.records.errors import ConfigError, RunError

MOST_JOBS = 10_000
IsFinished = Callable[[dict[str, Any], list[str]], bool]
"""Whether the job of a configuration, reached by these overrides, has been done before."""


@dataclass(frozen=True)
class Job:
    """One combination: the overrides that lead to it, and the whole configuration, not checked yet."""

    overrides: list[str]
    config: dict[str, Any]


@dataclass(frozen=True)
class Plan:
    """All jobs of a sweep, no two of them the same, and the configuration that its launcher takes."""

    config: DictConfig
    jobs: list[Job]

    @property
    def launcher(self) -> dict[str, Any]:
        """The launcher's part of the configuration, as plain containers."""
        node = OmegaConf.to_container(self.config.hydra.launcher, resolve=True)
        assert isinstance(node, dict)
        return {str(key): value for key, value in node.items()}


def sweep(task: Task, words: list[str], config_name: str, is_finished: IsFinished | None) -> list[Ending]:
    """Run every combination and collect how the jobs ended, in the order of the combinations.

    A launcher may run the jobs in other processes, on other machines: they share a folder of records. It is removed
    where no job needs it any more and none failed. It stays when this process is stopped: jobs in a queue outlive it.
    """
    with hydra.initialize_config_dir(str(conf_folder()), job_name="phd_exp", version_base="1.3"):
        planned = plan(words, config_name)
        _announce(planned.jobs, is_finished)
        folder = Path(planned.config.hydra.sweep.dir).absolute() / f"launch-{uuid.uuid4().hex[:8]}"
        records = JobRecords.begin(folder)
        gave_up = _run(task, planned, records)
    endings = [records.ending(number, job.overrides) for number, job in enumerate(planned.jobs)]
    if not any(ending.exit_status for ending in endings):
        if gave_up is not None:
            raise gave_up
        records.remove()
    _print_states(endings)
    return endings


def plan(words: list[str], config_name: str) -> Plan:
    """What the words of a command line stand for; Hydra has to be initialised.

    A word has precedence over what an experiment says of the same key. Combinations that come to the same
    configuration, as those that two experiments have in common, are one job.

    Raises HydraException or OmegaConfBaseException where any combination cannot be composed, ConfigError where there
    is none.
    """
    loader = GlobalHydra.instance().config_loader()
    jobs: dict[str, Job] = {}
    for chosen in _one_experiment_each(words, loader):
        master = loader.load_configuration(config_name, chosen, RunMode.MULTIRUN)
        for overrides in _combinations(chosen, master, loader):
            composed = loader.load_sweep_config(master, overrides)
            with open_dict(composed):
                del composed["hydra"]
            config = plain(composed)
            jobs.setdefault(json.dumps(config, sort_keys=True), Job(overrides, config))
    if not jobs:
        raise ConfigError(f"{' '.join(words)}: not one combination; does a glob(...) match nothing?")
    return Plan(master, list(jobs.values()))


def _one_experiment_each(words: list[str], loader: ConfigLoader) -> Iterator[list[str]]:
    """The words once for each experiment named, since each brings combinations of its own."""
    overrides = OverridesParser.create(loader).parse_overrides(words)
    several = [item for item in overrides if item.key_or_group == "experiment" and item.is_sweep_override()]
    if not several:
        yield words
        return
    others = [word for word, item in zip(words, overrides, strict=True) if item not in several]
    for choice in several[-1].sweep_string_iterator():
        yield [f"experiment={choice}", *others]


def _combinations(words: list[str], master: DictConfig, loader: ConfigLoader) -> list[list[str]]:
    parse = OverridesParser.create(loader).parse_overrides
    said = [item for item in parse(words) if not item.is_hydra_override()]
    keys = {item.key_or_group for item in said}
    params = parse([f"{key}={value}" for key, value in (master.hydra.sweeper.params or {}).items()])
    unsaid = [item for item in params if item.key_or_group not in keys]
    _require_countable([*unsaid, *said])
    (combinations,) = BasicSweeper.split_arguments([*unsaid, *said], max_batch_size=None)
    return combinations


def _require_countable(overrides: list[Override]) -> None:
    """Raise ConfigError for a range that would be counted out in memory, number by number, without end."""
    for item in overrides:
        value = item.value()
        if isinstance(value, RangeSweep) and _span(value) > MOST_JOBS * abs(value.step):
            raise ConfigError(f"{item.input_line}: more than {MOST_JOBS} jobs; expected a shorter range")


def _span(values: RangeSweep) -> float:
    return abs(float(values.stop or 0) - float(values.start or 0))


def _run(task: Task, planned: Plan, records: JobRecords) -> Exception | None:
    """Let the launcher run the jobs; returns the error with which it gave up, if it did so on the way."""
    parent = os.getpid() if planned.launcher["_target_"].endswith(".JoblibLauncher") else None
    launch = Launch(records, cores_a_job(planned.launcher, len(planned.jobs)), parent)
    context = HydraContext(
        config_loader=GlobalHydra.instance().config_loader(), callbacks=Callbacks(planned.config)
    )
    try:
        launcher = Plugins.instance().instantiate_launcher(
            hydra_context=context, task_function=launch.function(task), config=planned.config
        )
        for done in launcher.launch([job.overrides for job in planned.jobs], initial_job_idx=0):
            _ = done.return_value  # raises what went wrong around the job
    except (HydraException, OmegaConfBaseException):
        records.remove()
        raise
    except Exception as error:  # joblib's, Ray's and submitit's way to say that a job has died
        if any(records.path.iterdir()):
            return error
        records.remove()
        reason = " ".join(str(error).split())
        raise RunError(
            f"the launcher failed before any job began ({type(error).__name__}: {reason}); "
            "choose another by hydra/launcher=NAME"
        ) from error
    return None


def _announce(jobs: list[Job], is_finished: IsFinished | None) -> None:
    line = _counted(len(jobs))
    if is_finished is not None:
        line += f", {sum(is_finished(job.config, job.overrides) for job in jobs)} of them finished already"
    print(line, flush=True)


def _print_states(endings: list[Ending]) -> None:
    shared = set.intersection(*(set(ending.overrides) for ending in endings))
    for ending in endings:
        own = [override for override in ending.overrides if override not in shared]
        print(f"{' '.join(own or ending.overrides)}: {ending.state}")
    states = Counter(ending.state for ending in endings)
    summary = ", ".join(f"{count} {state}" for state, count in states.items())
    print(f"{_counted(len(endings))}: {summary}", flush=True)


def _counted(jobs: int) -> str:
    return "1 job" if jobs == 1 else f"{jobs} jobs"

"""A sweep: every combination once, finished runs skipped, each outcome named at the end.

Hydra calls it through its plugin `hydra_plugins/phd_exp_sweeper.py`; `hydra/sweeper=NAME` chooses another sweeper.
"""

import itertools
import json
import math
import os
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, RangeSweep
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, open_dict
from omegaconf.errors import OmegaConfBaseException

from phd_exp.cli.frame import RESUMES, Ending, print_errors
from phd_exp.cli.jobs import Job, plain
from phd_exp.records.errors import ConfigError, RunError
from phd_exp.records.processes import usable_cores

MOST_JOBS = 10_000
SECONDS_BETWEEN_LOOKS = 1.0


@dataclass(frozen=True)
class Combination:
    """One job to be: the overrides that lead to it, and the whole configuration, not checked yet."""

    overrides: list[str]
    config: dict[str, Any]


@dataclass(frozen=True)
class Plan:
    """All jobs of a sweep, no two of them the same, and the configuration that its launcher takes."""

    config: DictConfig
    jobs: list[Combination]

    @property
    def launcher(self) -> dict[str, Any]:
        """The launcher's part of the configuration, as plain containers."""
        return plain(self.config.hydra.launcher)


def sweep(job: Job, config: DictConfig, context: HydraContext, arguments: list[str]) -> list[float | None]:
    """Run every combination, with the launcher that `config` names; returns the scores.

    A failing job stops no other, whatever launcher runs the jobs and wherever. `job` keeps the endings.
    """
    planned = plan([*config.hydra.overrides.hydra, *arguments], config.hydra.job.config_name)
    finished = [_standing(job, combination) == "finished" for combination in planned.jobs]
    tail = f", {sum(finished)} of them finished already" if job.standing else ""
    print(f"{_counted(len(finished))}{tail}", flush=True)
    endings = [
        ending._replace(state="finished already") if before and ending.exit_status == 0 else ending
        for before, ending in zip(finished, _run(job, planned, context), strict=True)
    ]
    _print_outcome(planned.jobs, endings)
    job.endings.extend(endings)
    return [ending.value for ending in endings]


def _standing(job: Job, combination: Combination) -> str | None:
    return job.standing(combination.config, combination.overrides) if job.standing else None


def _run(job: Job, planned: Plan, context: HydraContext) -> list[Ending]:
    """Let the launcher run the jobs; returns their endings in the order of the jobs."""
    n, is_joblib = len(planned.jobs), planned.launcher["_target_"].endswith(".JoblibLauncher")
    cores, parent = cores_a_job(planned.launcher, n), os.getpid() if is_joblib else None
    try:
        launcher = Plugins.instance().instantiate_launcher(
            context, replace(job, n_jobs=n, cores=cores, parent=parent).end, planned.config
        )
        returns = launcher.launch([combination.overrides for combination in planned.jobs], initial_job_idx=0)
        return [done.return_value for done in returns]
    except (HydraException, OmegaConfBaseException, OSError):
        raise
    except Exception as error:  # how joblib, Ray and submitit say that a job has died
        found = [_recorded(job, combination) for combination in planned.jobs]
        if any(ending and ending.exit_status for ending in found):
            missing = Ending("not started", (f"did not start; {RESUMES}",), 1)
            return [ending or missing for ending in found]
        reason = " ".join(str(error).split())
        raise RunError(
            f"the launcher failed ({type(error).__name__}: {reason}); choose another by hydra/launcher=NAME"
        ) from error


def _recorded(job: Job, combination: Combination) -> Ending | None:
    """How a job ended according to its record; waits for one that still runs. None if there is no record."""
    while (standing := _standing(job, combination)) == "running":
        time.sleep(SECONDS_BETWEEN_LOOKS)
    if standing is None:
        return None
    return Ending("finished") if standing == "finished" else Ending("failed", (f"{standing}; {RESUMES}",), 1)


def plan(words: list[str], config_name: str) -> Plan:
    """The jobs that the words of a command line stand for; Hydra has to be initialised.

    The command line overrides an experiment. Combinations with the same configuration, as those that two experiments
    have in common, are one job.

    Raises HydraException or OmegaConfBaseException where any combination cannot be composed, ConfigError where there
    is none or there are too many.
    """
    loader = GlobalHydra.instance().config_loader()
    jobs: dict[str, Combination] = {}
    for chosen in _one_experiment_each(words, loader):
        master = loader.load_configuration(config_name, chosen, RunMode.MULTIRUN)
        for overrides in _combinations(chosen, master, loader):
            composed = loader.load_sweep_config(master, overrides)
            with open_dict(composed):
                del composed["hydra"]
            config = plain(composed)
            jobs.setdefault(json.dumps(config, sort_keys=True), Combination(overrides, config))
    if not jobs:
        raise ConfigError(f"{_given(words)}: not one combination; does a glob(...) match nothing?")
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
    given = [item for item in parse(words) if not item.is_hydra_override()]
    keys = {item.key_or_group for item in given}
    params = parse([f"{key}={value}" for key, value in (master.hydra.sweeper.params or {}).items()])
    values: dict[str, list[str]] = {}
    for item in [*(item for item in params if item.key_or_group not in keys), *given]:
        key = item.get_key_element()
        values[key] = [f"{key}={value}" for value in _values(item)]
    if math.prod(map(len, values.values())) > MOST_JOBS:
        raise ConfigError(f"{_given(words)}: more than {MOST_JOBS} jobs; expected fewer values")
    return [list(combination) for combination in itertools.product(*values.values())]


def _given(words: list[str]) -> str:
    return " ".join(word for word in words if not word.startswith("hydra."))


def _values(item: Override) -> list[str]:
    """The values of an override as text. Raises ConfigError for a range too long to be expanded."""
    if not item.is_sweep_override():
        return [item.get_value_element_as_str()]
    value = item.value()
    # a comparison with NaN is false
    if isinstance(value, RangeSweep) and not _span(value) <= MOST_JOBS * abs(value.step):
        raise ConfigError(f"{item.input_line}: more than {MOST_JOBS} jobs; expected a shorter range")
    return list(item.sweep_string_iterator())


def _span(values: RangeSweep) -> float:
    return abs((values.stop or 0) - (values.start or 0))


def cores_a_job(launcher: Mapping[str, Any], jobs: int) -> int | None:
    """The share of each job where a launcher runs several at once on this machine, at least one core.

    None where a job has all cores that its process may use: with Hydra's basic launcher, in a queue.

    Args:
        launcher: its section of the configuration.
        jobs: how many there are to run.
    """
    match str(launcher["_target_"]).rpartition(".")[2]:
        case "JoblibLauncher":
            n = launcher["n_jobs"]
            return _share(
                min(jobs, n if n > 0 else max(1, usable_cores() + 1 + n))
            )  # -1 stands for all cores
        case "LocalLauncher":  # submitit without a queue starts all jobs at once
            return _share(jobs)
        case "RayLauncher":  # starts as many jobs as their cores allow, one each by default
            return int(launcher["ray"]["remote"].get("num_cpus") or 1)
    return None


def _share(jobs_at_once: int) -> int:
    return max(1, usable_cores() // jobs_at_once)


def _print_outcome(jobs: list[Combination], endings: list[Ending]) -> None:
    """Print the outcome of each job by the overrides that set it apart, then every error by all its overrides."""
    shared = set.intersection(*(set(job.overrides) for job in jobs))
    for job, ending in zip(jobs, endings, strict=True):
        own = [override for override in job.overrides if override not in shared]
        print(f"{' '.join(own or job.overrides)}: {ending.state}")
    states = Counter(ending.state for ending in endings)
    print(f"{_counted(len(jobs))}: {', '.join(f'{n} {state}' for state, n in states.items())}", flush=True)
    failed = sum(ending.exit_status > 0 for ending in endings)
    if failed > 1:
        print_errors([f"{failed} jobs failed"])
    for job, ending in zip(jobs, endings, strict=True):
        print_errors(f"{' '.join(job.overrides)}: {line}" for line in ending.lines)


def _counted(jobs: int) -> str:
    return "1 job" if jobs == 1 else f"{jobs} jobs"

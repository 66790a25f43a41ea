"""A sweep: every combination once, finished runs skipped, each outcome printed at the end.

Hydra calls it through its plugin `hydra_plugins/phd_exp_sweeper.py`; `hydra/sweeper=NAME` selects another sweeper.
"""

import json
import math
import os
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import islice, product
from typing import Any, NamedTuple

from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, open_dict

from phd_exp.cli.frame import RESUMES, Ending, print_errors
from phd_exp.cli.jobs import Job, plain
from phd_exp.cli.words import REFUSED, explain
from phd_exp.records.errors import ConfigError, RunError
from phd_exp.records.processes import usable_cores

MOST_JOBS = 10_000
SECONDS_BETWEEN_LOOKS = 1.0


class Combination(NamedTuple):
    """The whole configuration of one job, not checked yet, and its overrides."""

    config: dict[str, Any]
    overrides: list[str]


def sweep(job: Job, config: DictConfig, context: HydraContext, arguments: list[str]) -> list[float | None]:
    """Run every combination with the launcher in `config`; returns the scores.

    A failed job does not stop the others, with any launcher. `job.endings` receives the endings.
    """
    master, jobs = plan([*config.hydra.overrides.hydra, *arguments], config.hydra.job.config_name)
    finished = [job.standing is not None and job.standing(*combination) == "finished" for combination in jobs]
    tail = f", {sum(finished)} of them finished already" if job.standing else ""
    print(f"{_counted(len(jobs))}{tail}", flush=True)
    endings = [
        ending._replace(state="finished already") if before and ending.exit_status == 0 else ending
        for before, ending in zip(finished, _run(job, master, jobs, context), strict=True)
    ]
    _print_outcome(job, jobs, endings)
    job.endings.extend(endings)
    return [ending.value for ending in endings]


def _run(job: Job, master: DictConfig, jobs: list[Combination], context: HydraContext) -> list[Ending]:
    """Let the launcher run the jobs; returns their endings in the order of the jobs."""
    launcher = plain(master.hydra.launcher)
    parent = os.getpid() if launcher["_target_"].endswith(".JoblibLauncher") else None
    shared = replace(job, n_jobs=len(jobs), cores=cores_a_job(launcher, len(jobs)), parent=parent)
    try:
        runner = Plugins.instance().instantiate_launcher(context, shared.end, master)
        returns = runner.launch([combination.overrides for combination in jobs], initial_job_idx=0)
        return [done.return_value for done in returns]
    except (*REFUSED, OSError):
        raise
    except Exception as error:  # joblib, Ray and submitit raise when a job's process dies
        found = [_recorded(job, combination) for combination in jobs]
        if any(ending and ending.exit_status for ending in found):
            missing = Ending("not started", (f"did not start; {RESUMES}",), 1)
            return [ending or missing for ending in found]
        reason = " ".join(str(error).split())
        raise RunError(
            f"the launcher failed ({type(error).__name__}: {reason}); choose another by hydra/launcher=NAME"
        ) from error


def _recorded(job: Job, combination: Combination) -> Ending | None:
    """The ending of a job according to its record, once it no longer runs. None without a record."""
    while (standing := job.standing and job.standing(*combination)) == "running":
        time.sleep(SECONDS_BETWEEN_LOOKS)
    if standing in (None, "finished"):
        return Ending("finished") if standing else None
    return Ending("failed", (f"{standing}; {RESUMES}",), 1)


def plan(words: list[str], config_name: str) -> tuple[DictConfig, list[Combination]]:
    """The configuration of the launcher and the jobs that a command line describes. Hydra must be initialised.

    The command line overrides an experiment. Combinations with equal configurations, which two experiments may share,
    are one job.

    Raises ConfigError if a combination cannot be composed, if there are no combinations or too many.
    """
    loader = GlobalHydra.instance().config_loader()
    jobs: dict[str, Combination] = {}
    for chosen in _one_experiment_each(words, loader):
        master = loader.load_configuration(config_name, chosen, RunMode.MULTIRUN)
        for overrides in _combinations(chosen, master, loader):
            try:
                composed = loader.load_sweep_config(master, overrides)
            except REFUSED as error:
                GlobalHydra.instance().clear()  # the sweep ends here, and an explanation composes
                raise ConfigError(f"{' '.join(overrides)}: {explain(error, config_name)}") from error
            with open_dict(composed):
                del composed["hydra"]
            config = plain(composed)
            jobs.setdefault(json.dumps(config, sort_keys=True), Combination(config, overrides))
    if not jobs:
        raise ConfigError(f"{_given(words)}: not one combination; does a glob(...) match nothing?")
    return master, list(jobs.values())


def _one_experiment_each(words: list[str], loader: ConfigLoader) -> Iterator[list[str]]:
    """The words once for each experiment, because each experiment has its own combinations."""
    overrides = OverridesParser.create(loader).parse_overrides(words)
    several = [item for item in overrides if item.key_or_group == "experiment" and item.is_sweep_override()]
    if not several:
        yield words
        return
    others = [word for word, item in zip(words, overrides, strict=True) if item not in several]
    for choice in several[-1].sweep_string_iterator():
        yield [f"experiment={choice}", *others]


def _combinations(words: list[str], master: DictConfig, loader: ConfigLoader) -> list[list[str]]:
    """The overrides of each job: every combination of values, once with each list of overrides of an experiment."""
    parse = OverridesParser.create(loader).parse_overrides
    given = [item for item in parse(words) if not item.is_hydra_override()]
    keys = {item.key_or_group for item in given}
    params = parse([f"{key}={value}" for key, value in (master.hydra.sweeper.params or {}).items()])
    values: dict[str, list[str]] = {}
    for item in [*(item for item in params if item.key_or_group not in keys), *given]:
        key = item.get_key_element()
        values[key] = [f"{key}={value}" for value in _values(item)]
    each = [parse(list(overrides)) for overrides in master.hydra.sweeper.get("each") or [[]]]
    if math.prod(map(len, values.values())) * len(each) > MOST_JOBS:
        raise ConfigError(f"{_given(words)}: more than {MOST_JOBS} jobs; expected fewer values")
    further = [[str(item.input_line) for item in items if item.key_or_group not in keys] for items in each]
    return [[*combination, *together] for together in further for combination in product(*values.values())]


def _given(words: list[str]) -> str:
    return " ".join(word for word in words if not word.startswith("hydra."))


def _values(item: Override) -> Iterator[str]:
    """The values of an override as text, of a range without end the first ones."""
    if item.is_sweep_override():
        return islice(item.sweep_string_iterator(), MOST_JOBS + 1)
    return iter([item.get_value_element_as_str()])


def cores_a_job(launcher: Mapping[str, Any], jobs: int) -> int | None:
    """The number of cores of each of `jobs` jobs, at least 1, if `launcher` runs several at once on this machine.

    None if a job may use all cores of its process: with Hydra's basic launcher, or in a queue.
    """
    match str(launcher["_target_"]).rpartition(".")[2]:
        case "JoblibLauncher":
            n = launcher["n_jobs"]
            at_once = n if n > 0 else max(1, usable_cores() + 1 + n)  # -1 stands for all cores
            return max(1, usable_cores() // min(jobs, at_once))
        case "LocalLauncher":  # submitit without a queue starts all jobs at once
            return max(1, usable_cores() // jobs)
        case "RayLauncher":  # starts as many jobs as their cores allow, one core each by default
            return int(launcher["ray"]["remote"].get("num_cpus") or 1)
    return None


def _print_outcome(job: Job, jobs: list[Combination], endings: list[Ending]) -> None:
    """Print how each job ended with the overrides that distinguish it, then every error with all overrides."""
    shared = set.intersection(*(set(one.overrides) for one in jobs))
    for one, ending in zip(jobs, endings, strict=True):
        own = [override for override in one.overrides if override not in shared]
        numbers = job.numbers(*one) if job.numbers and ending.exit_status == 0 else ""
        print(f"{' '.join(own or one.overrides)}: {ending.state}{', ' if numbers else ''}{numbers}")
    states = Counter(ending.state for ending in endings)
    print(f"{_counted(len(jobs))}: {', '.join(f'{n} {state}' for state, n in states.items())}", flush=True)
    failed = sum(ending.exit_status > 0 for ending in endings)
    if failed > 1:
        print_errors([f"{failed} jobs failed"])
    for one, ending in zip(jobs, endings, strict=True):
        print_errors(f"{' '.join(one.overrides)}: {line}" for line in ending.lines)


def _counted(jobs: int) -> str:
    return "1 job" if jobs == 1 else f"{jobs} jobs"

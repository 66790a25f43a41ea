"""Hydra as this programme uses it: compose, check, run; every mistake of the user is one line."""

import os
import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import hydra
from hydra._internal.utils import get_args_parser
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from phd_exp.cli.jobs import BAD_CONFIGURATION, Ending, JobRecords, Launch, Task
from phd_exp.cli.paths import conf_folder
from phd_exp.cli.signals import Stopped, stopping_on_signals
from phd_exp.cli.sweep import IsFinished, sweep
from phd_exp.cli.words import require_visible
from phd_exp.records.errors import ConfigError, UserError, nearest

LONGEST = 400
"""Characters of what Hydra says."""
MULTIRUN = ("-m", "--multirun")


def launch(
    task: Task, arguments: list[str], config_name: str = "config", is_finished: IsFinished | None = None
) -> int:
    """Run a task through Hydra, once or (-m) for every combination; returns the exit status.

    In a sweep one failing job does not stop the others, whatever launcher runs them and wherever; at the end
    every failure is named, and so is every job that died without a word.

    Args:
        task: what a job does.
        arguments: the words of the command line after the verb.
        config_name: the file under conf/ that they change.
        is_finished: which jobs of a sweep need not do it again, for what is said when it begins.
    """
    # Hydra would print errors its own way, over several lines, and exit; we want them as exceptions
    os.environ["HYDRA_FULL_ERROR"] = "1"
    # argparse takes the overrides in one piece alone: flags to the front, wherever the user put them
    arguments = sorted(arguments, key=lambda word: word not in MULTIRUN)
    sys.argv = [sys.argv[0], *arguments]
    try:
        require_visible(arguments)
        with stopping_on_signals():
            endings = _run_all(task, arguments, config_name, is_finished)
    except Stopped as stop:
        print(f"error: stopped by {stop}; the same command goes on from here", file=sys.stderr)
        return int(str(stop.code))
    except (HydraException, OmegaConfBaseException, ValueError) as error:  # ValueError: a group set to null
        print(f"error: {explain(error, config_name)}", file=sys.stderr)
        return BAD_CONFIGURATION
    except OSError as error:  # what goes wrong within a job is the job's to record
        print(
            f"error: {error.filename}: cannot be written ({error.strerror}); check hydra.*.dir",
            file=sys.stderr,
        )
        return BAD_CONFIGURATION
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return Ending.of([], error).exit_status
    _print_failures(endings)
    return max((ending.exit_status for ending in endings), default=0)


def _run_all(
    task: Task, arguments: list[str], config_name: str, is_finished: IsFinished | None
) -> list[Ending]:
    """Run the jobs and collect how they ended."""
    _require_known_flags(arguments)
    flags = [word for word in arguments if word.startswith("-")]
    if len(flags) == 1 and flags[0] in MULTIRUN:
        return sweep(task, arguments[1:], config_name, is_finished)
    if not flags:
        _require_one_run(arguments)
    with tempfile.TemporaryDirectory(prefix="phd_exp-") as folder:
        records = JobRecords(Path(folder))
        job = Launch(records).function(task)
        hydra.main(version_base="1.3", config_path=str(conf_folder()), config_name=config_name)(job)()
        # a flag like --cfg runs no job
        return [records.ending(0, [])] if any(records.path.iterdir()) else []


def _require_known_flags(words: list[str]) -> None:
    """Raise ConfigError for what Hydra's parser would refuse with its usage, over several lines."""

    def refuse(message: str) -> NoReturn:
        raise ConfigError(f"{message}; see `python -m phd_exp --help`")

    parser = get_args_parser()
    parser.error = refuse  # type: ignore[method-assign]
    parser.parse_args(words)


def _require_one_run(words: list[str]) -> None:
    for word in words:
        if word.partition("=")[0].lstrip("+") == "experiment":
            raise ConfigError(
                f"{word}: an experiment is several runs; write -m before it: -m {' '.join(words)}"
            )


def explain(error: Exception, config_name: str) -> str:
    """One line for what Hydra refuses: what was written, why it does not fit, the nearest thing that does."""
    text = " ".join(str(error).split())
    unknown = re.search(r"Could not override '([^']+)'", text)
    if unknown:
        key = unknown[1].lstrip("+~")
        if owners := _choices_with(key):
            return f"{key}: not a key of this choice, but of {' or '.join(owners)}; name that choice too"
        verb = "" if config_name == "config" else f" {config_name}"
        close = nearest(key, _known_keys(config_name))
        return f"{key}: unknown key{close}; see `python -m phd_exp{verb} --cfg job`"
    choice = re.search(
        r"Could not find '([^']+)/([^']+)' Available options in '[^']+': (.*?) Config search path", text
    )
    if choice:
        group, name, options = choice[1], choice[2], choice[3].split()
        return f"{group}={name}: no such choice{nearest(name, options)}; expected one of {', '.join(options)}"
    text = re.sub(r" Set the environment variable.*| Config search path:.*", "", text)
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."


def _print_failures(endings: list[Ending]) -> None:
    failures = [ending for ending in endings if ending.exit_status]
    if len(failures) > 1:
        print(f"error: {len(failures)} runs failed", file=sys.stderr)
    for failure in failures:
        run = f"{' '.join(failure.overrides)}: " if len(endings) > 1 else ""
        for line in failure.lines:
            print(f"error: {run}{line}", file=sys.stderr)


def _known_keys(config_name: str) -> list[str]:
    """Every key and group of the default configuration, with dots."""
    with hydra.initialize_config_dir(str(conf_folder()), version_base="1.3"):
        config = hydra.compose(config_name)
    groups = [path.name for path in conf_folder().iterdir() if path.is_dir()]
    return groups + list(_dotted(OmegaConf.to_container(config)))


def _choices_with(key: str) -> list[str]:
    """The choices of a group whose file has a key, with dots."""
    group, _, leaf = key.partition(".")
    files = sorted((conf_folder() / group).glob("*.yaml")) if leaf else []
    # a list, since a DictConfig denies to hold what is ???
    return [f"{group}={file.stem}" for file in files if leaf in list(OmegaConf.load(file))]


def _dotted(node: Any, prefix: str = "") -> Iterator[str]:
    for key, value in node.items() if isinstance(node, dict) else ():
        yield f"{prefix}{key}"
        yield from _dotted(value, f"{prefix}{key}.")

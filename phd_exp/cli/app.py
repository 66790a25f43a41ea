"""Hydra as this programme uses it: compose, check, run; every mistake of the user is one line."""

import os
import re
import sys
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from phd_exp.cli.paths import conf_folder
from phd_exp.cli.signals import Stopped, stopping_on_signals
from phd_exp.records.errors import ConfigError, UserError, nearest

BAD_CONFIGURATION = 2
FAILED = 1
MULTIRUN = ("-m", "--multirun")


@dataclass(frozen=True)
class Failure:
    """A job that did not finish: what was asked for, and why not."""

    overrides: list[str]
    error: Exception

    @property
    def exit_status(self) -> int:
        return BAD_CONFIGURATION if isinstance(self.error, ConfigError) else FAILED

    @property
    def lines(self) -> list[str]:
        """What is wrong, one thing a line."""
        if isinstance(self.error, UserError):
            return str(self.error).splitlines()
        return [f"{type(self.error).__name__}: {' '.join(str(self.error).split())}"]


Task = Callable[[dict[str, Any], list[str]], None]
"""Takes the resolved configuration and the overrides that led to it."""


def launch(task: Task, arguments: list[str], config_name: str = "config") -> int:
    """Run a task through Hydra, once or (-m) for every combination; returns the exit status.

    In a sweep one failing job does not stop the others; at the end every failure is named.
    """
    # Hydra would print errors its own way, over several lines, and exit; we want them as exceptions
    os.environ["HYDRA_FULL_ERROR"] = "1"
    failures: list[Failure] = []

    def job(config: DictConfig) -> None:
        overrides = list(HydraConfig.get().overrides.task)
        try:
            task(_plain(config), overrides)
        except Exception as error:
            if not isinstance(error, UserError):
                traceback.print_exc()  # a fault of the programme, not of its user
            failures.append(Failure(overrides, error))

    decorated = hydra.main(version_base="1.3", config_path=str(conf_folder()), config_name=config_name)(job)
    # argparse takes the overrides in one piece alone: flags to the front, wherever the user put them
    sys.argv = [sys.argv[0], *sorted(arguments, key=lambda word: word not in MULTIRUN)]
    try:
        with stopping_on_signals():
            decorated()
    except Stopped as stop:
        print(f"error: stopped by {stop}; the same command goes on from here", file=sys.stderr)
        return int(str(stop.code))
    except (HydraException, OmegaConfBaseException) as error:
        print(f"error: {explain(error, config_name)}", file=sys.stderr)
        return BAD_CONFIGURATION
    _print(failures)
    return max((failure.exit_status for failure in failures), default=0)


def explain(error: Exception, config_name: str) -> str:
    """One line for what Hydra refuses: what was written, why it does not fit, the nearest thing that does."""
    text = " ".join(str(error).split())
    unknown = re.search(r"Could not override '([^']+)'", text)
    if unknown:
        key = unknown[1].lstrip("+~")
        if owners := _choices_with(key):
            return f"{key}: not a key of this choice, but of {' or '.join(owners)}; name that choice too"
        return (
            f"{key}: unknown key{nearest(key, _known_keys(config_name))}; see `python -m phd_exp --cfg job`"
        )
    choice = re.search(
        r"Could not find '([^']+)/([^']+)' Available options in '[^']+': (.*?) Config search path", text
    )
    if choice:
        group, name, options = choice[1], choice[2], choice[3].split()
        return f"{group}={name}: no such choice{nearest(name, options)}; expected one of {', '.join(options)}"
    return re.sub(r" Set the environment variable.*| Config search path:.*", "", text)


def _print(failures: list[Failure]) -> None:
    if len(failures) > 1:
        print(f"error: {len(failures)} runs failed", file=sys.stderr)
    for failure in failures:
        run = f"{' '.join(failure.overrides)}: " if len(failures) > 1 else ""
        for line in failure.lines:
            print(f"error: {run}{line}", file=sys.stderr)


def _plain(config: DictConfig) -> dict[str, Any]:
    """The configuration as plain containers, every interpolation resolved; what is missing is left for the check."""
    plain = _without_missing(OmegaConf.to_container(config, resolve=True))
    return {str(key): value for key, value in plain.items()}


def _without_missing(node: Any) -> Any:
    if not isinstance(node, dict):
        return node
    return {key: _without_missing(value) for key, value in node.items() if value != MISSING}


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

"""Hydra as the verbs `train` and `render` use it: one run, or with -m a sweep."""

import os
import re
import sys
from typing import NoReturn

import hydra
from hydra._internal.utils import get_args_parser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from phd_exp.cli.frame import print_errors
from phd_exp.cli.jobs import Job, Standing, Task, refusal
from phd_exp.cli.paths import conf_folder
from phd_exp.records.errors import ConfigError, nearest

LONGEST = 400
"""Characters of Hydra's messages that are repeated."""
REFUSED = (HydraException, OmegaConfBaseException, ValueError, ArithmeticError, RecursionError)
"""What composing raises for a bad override; ValueError for a group set to null."""


def launch(
    task: Task, words: list[str], config_name: str = "config", standing: Standing | None = None
) -> int:
    """Run a task through Hydra, once or (-m) for every combination; returns the exit status.

    Args:
        task: what a job does.
        words: the words of the command line after the verb.
        config_name: the file under conf/ that they change.
        standing: how a job stands on disk.

    Raises RunError where a launcher fails.
    """
    # Hydra would print errors its own way, over several lines, and exit
    os.environ["HYDRA_FULL_ERROR"] = "1"
    job = Job(task, standing)
    try:
        sys.argv = [sys.argv[0], *_options_last(words)]
        hydra.main(version_base="1.3", config_path=str(conf_folder()), config_name=config_name)(job)()
    except (*REFUSED, ConfigError) as error:
        refused = error if isinstance(error, ConfigError) else ConfigError(explain(error, config_name))
        job.endings.append(refusal(refused))
        print_errors(job.endings[-1].lines)
    return max((ending.exit_status for ending in job.endings), default=0)


def _options_last(words: list[str]) -> list[str]:
    """The words with Hydra's options after the overrides; its parser wants the overrides in one piece.

    Raises ConfigError for what it would refuse with its usage, over several lines.
    """

    def refuse(message: str) -> NoReturn:
        raise ConfigError(f"{message}; see `python -m phd_exp --help`")

    parser = get_args_parser()
    parser.error = refuse  # type: ignore[method-assign]
    overrides = parser.parse_intermixed_args(words).overrides
    options = list(words)
    for word in overrides:
        options.remove(word)
    return [*overrides, *options]


def explain(error: Exception, config_name: str) -> str:
    """One line for what Hydra refuses: what was written, why it does not fit, the nearest thing that does."""
    text = " ".join(str(error).split())
    unknown = re.search(r"Could not override '([^']+)'", text)
    if unknown:
        key = unknown[1].lstrip("+~")
        if owners := _choices_with(key):
            return f"{key}: not a key of this choice, but of {' or '.join(owners)}; name that choice too"
        section, _, leaf = key.rpartition(".")
        valid = _keys_of(section, config_name)
        verb = "" if config_name == "config" else f" {config_name}"
        keys = (
            f"expected one of {', '.join(valid)}" if section else f"see `python -m phd_exp{verb} --cfg job`"
        )
        return f"{key}: unknown key{nearest(leaf, valid)}; {keys}"
    choice = re.search(
        r"Could not find '([^']+)/([^']+)' Available options in '[^']+': (.*?) Config search path", text
    )
    if choice:
        group, name, options = choice[1], choice[2], choice[3].split()
        return f"{group}={name}: no such choice{nearest(name, options)}; expected one of {', '.join(options)}"
    text = re.sub(r" Set the environment variable.*| Config search path:.*", "", text)
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."


def _keys_of(section: str, config_name: str) -> list[str]:
    """The keys of a section of the default configuration; of none, its groups and sections."""
    with hydra.initialize_config_dir(str(conf_folder()), version_base="1.3"):
        config = hydra.compose(config_name)
    node = OmegaConf.select(config, section) if section else config
    groups = [] if section else [path.name for path in conf_folder().iterdir() if path.is_dir()]
    return groups + [str(key) for key in (node if isinstance(node, DictConfig) else ())]


def _choices_with(key: str) -> list[str]:
    """The choices of a group whose file has a key, with dots."""
    group, _, leaf = key.partition(".")
    files = sorted((conf_folder() / group).glob("*.yaml")) if leaf else []
    # a list, since a DictConfig denies to hold what is ???
    return [f"{group}={file.stem}" for file in files if leaf in list(OmegaConf.load(file))]

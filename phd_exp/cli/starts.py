"""A training that starts from a finished run (`init=`) has the network of that run."""

from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser

from phd_exp.config import RunConfig, check
from phd_exp.config.targets import is_ours
from phd_exp.records.errors import ConfigError, RunError
from phd_exp.records.runs import RunFolder

OF_NETWORK = (
    ("backbone", None),
    ("camera", None),
    ("recipe", "hidden"),
    ("recipe", "exposure"),
    ("data", "image_size"),
)
"""The sections and keys that describe a network and its inputs."""


def checked_start(config: dict[str, Any], overrides: list[str]) -> RunConfig:
    """The checked configuration of a training, with the network of the run that it starts from, if any.

    Raises ConfigError and RunError as `check` and `with_network_of` do.
    """
    start = config.get("init")  # the configuration alone may have larger images than it renders: not checked before
    if start and isinstance(start, str):
        config = with_network_of(RunFolder(Path(start)), config, overrides)
    return check(config)


def with_network_of(start: RunFolder, config: dict[str, Any], overrides: list[str]) -> dict[str, Any]:
    """A configuration with the network of a finished run, except for what the command line names.

    Raises ConfigError if the run is not finished, and if its network is not of this project: such a network is only
    built if the command line names it. Raises RunError for a record that cannot be read.
    """
    if not start.is_finished():
        raise ConfigError(f"init: got {start.path}; expected the folder of a finished run")
    recorded, changed = start.config(), dict(config)
    words = [f"{item.key_or_group}." for item in OverridesParser.create().parse_overrides(overrides)]
    for section, key in OF_NETWORK:
        name = f"{section}.{key}" if key else section
        if any(word.startswith(f"{name}.") for word in words):
            continue
        try:
            # older records lack a key whose default they had
            changed[section] = _with(changed[section], recorded[section], key) if key else recorded[section]
        except (KeyError, TypeError):
            raise RunError(f"{start.config_file}: not the configuration of a run") from None
    if changed["backbone"] is recorded.get("backbone") and not is_ours(changed["backbone"]):
        raise ConfigError(
            f"init: the network of {start.path} is not of this project; name it by backbone=CHOICE, or by "
            "backbone._target_=MODULE.NAME"
        )
    return changed


def _with(section: dict[str, Any], recorded: dict[str, Any], key: str) -> dict[str, Any]:
    """A section with the recorded value of a key, or without the key if the record has none."""
    others = {name: value for name, value in section.items() if name != key}
    return others | ({key: recorded[key]} if key in recorded else {})

"""The command line: one file a verb, each a thin layer over the other packages."""

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

PACKAGE = Path(__file__).resolve().parents[1]


def conf_folder() -> Path:
    """`conf/` of the checkout, or the copy inside an installed package."""
    installed = PACKAGE / "conf"
    return installed if installed.is_dir() else PACKAGE.parent / "conf"


def _read(file: Path) -> Any:
    import yaml  # importing this package alone takes no time

    return yaml.safe_load(file.read_text())


@cache
def short_choices() -> list[tuple[str, str, dict[str, Any], str | None]]:
    """Group, name, content and package of each choice in conf/choices.yaml."""
    groups = [(key.split("@"), choices) for key, choices in _read(conf_folder() / "choices.yaml").items()]
    return [
        (group, name, content, package[0] if package else None)
        for (group, *package), choices in groups
        for name, content in choices.items()
    ]


def all_choices(group: str) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Name, prefix of the keys, and content of each choice of a configuration group, whatever file it is in."""
    for file in (conf_folder() / group).glob("*.yaml"):
        yield file.stem, prefix_of(group, file.read_text()), _read(file) or {}
    for other, name, content, package in short_choices():
        if other == group:
            yield name, "" if package else f"{group}.", content


def choices_of(group: str) -> list[str]:
    """The choices of a configuration group, sorted."""
    files = [file.stem for file in (conf_folder() / group).glob("*.yaml")]
    return sorted([*files, *(name for other, name, *_ in short_choices() if other == group)])


def prefix_of(group: str, content: str) -> str:
    """What precedes the keys in a file of a group: nothing if the file sets keys of the whole configuration."""
    return f"{group}." if group and "# @package _global_" not in content else ""

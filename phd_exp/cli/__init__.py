"""The command line: one file a verb, each a thin layer over the other packages."""

from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]


def conf_folder() -> Path:
    """`conf/` of the checkout, or the copy inside an installed package."""
    installed = PACKAGE / "conf"
    return installed if installed.is_dir() else PACKAGE.parent / "conf"


def choices_of(group: str) -> list[str]:
    """The choices of a configuration group, sorted."""
    return sorted(file.stem for file in (conf_folder() / group).glob("*.yaml"))


def prefix_of(group: str, content: str) -> str:
    """What precedes the keys in a file of a group: nothing if the file sets keys of the whole configuration."""
    return f"{group}." if group and "# @package _global_" not in content else ""

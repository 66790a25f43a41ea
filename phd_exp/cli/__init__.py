"""The command line: one file a verb, each a thin layer over the other packages."""

from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]


def conf_folder() -> Path:
    """`conf/` of the checkout, or the copy inside an installed package."""
    installed = PACKAGE / "conf"
    return installed if installed.is_dir() else PACKAGE.parent / "conf"

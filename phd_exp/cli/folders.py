"""Verbs that take nothing but names of folders."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from phd_exp.cli.words import require_visible
from phd_exp.records.errors import UserError, nearest


def named_folders(verb: str, defaults: Mapping[str, str], arguments: Sequence[str]) -> dict[str, Path]:
    """The folders named by `key=DIR`, or their defaults. Raises UserError for an unknown key and anything else."""
    require_visible(arguments)
    folders = {key: Path(default) for key, default in defaults.items()}
    for argument in arguments:
        key, _, value = argument.partition("=")
        if key not in folders or not value:
            takes = " and ".join(f"{known}=DIR" for known in folders)
            close = "" if key in folders else nearest(key, folders)
            raise UserError(f"{argument}: {verb} takes {takes} and nothing else{close}")
        folders[key] = Path(value)
    return folders


def require_folder(key: str, folder: Path, advice: str) -> None:
    """Raise UserError, with what to do, where there is no such folder."""
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; {advice} by {key}=DIR")

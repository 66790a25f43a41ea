"""Verbs that take nothing but the name of a folder."""

from pathlib import Path

from phd_exp.records.errors import UserError


def named_folder(verb: str, key: str, default: str, arguments: list[str], *, if_missing: str) -> Path:
    """The folder named by `key=DIR`, or the default. Raises UserError for anything else, and where there is none."""
    folder = Path(default)
    for argument in arguments:
        name, _, value = argument.partition("=")
        if name != key or not value:
            raise UserError(f"{argument}: {verb} takes {key}=DIR and nothing else")
        folder = Path(value)
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; {if_missing} by {key}=DIR")
    return folder

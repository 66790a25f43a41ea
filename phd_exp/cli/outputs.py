"""Outputs of out= and view=: prepared, or refused, before anything is computed."""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from phd_exp.records.errors import ConfigError, writing
from phd_exp.records.files import remove_temporaries
from phd_exp.records.messages import MessageFile, require_rosbags
from phd_exp.records.recordings import MCAP, is_recording


def output_folder(out: Path) -> None:
    """Make a folder to write into. Raises ConfigError if that is impossible."""
    with writing(out, "out=", ConfigError):
        out.mkdir(parents=True, exist_ok=True)
        remove_temporaries(out)  # of a killed process


def require_file(out: Path, name: str) -> None:
    """Raise ConfigError if an output file is a folder; the message suggests `name` inside it."""
    if out.is_dir():
        raise ConfigError(f"out={out}: is a folder; expected a file, such as {out / name}")


def require_output(out: Path, name: str, inputs: Iterable[Path]) -> None:
    """Make the folder of an output file; the message about a folder suggests `name` inside it.

    Raises ConfigError if the file is a folder, an input, or in a recording that is a folder, cannot be written, or
    needs rosbags, which is missing.
    """
    require_file(out, name)
    read = {path.resolve() for path in inputs if not path.is_dir() or is_recording(path)}
    if read & {out.resolve(), out.resolve().parent}:
        raise ConfigError(
            f"out={out}: is one of the files that are read, or lies in the recording; choose another place"
        )
    if out.suffix == MCAP:
        require_rosbags("out")
    output_folder(out.parent)


@contextmanager
def message_file(out: Path | None) -> Iterator[MessageFile | None]:
    """The recording that out= names, open for writing; None if out= names no recording."""
    if out is None or out.suffix != MCAP:
        yield None
        return
    with MessageFile(out) as messages:
        yield messages


def new_view(view: Path) -> None:
    """Make the folder of a recording for Rerun. Raises ConfigError unless `view` is a new file *.rrd."""
    if view.suffix != ".rrd":
        raise ConfigError(f"view: got {view}; expected a file *.rrd, such as {view.with_name('view.rrd')}")
    if os.path.lexists(view):
        raise ConfigError(f"view: got {view}, which exists; expected a new file; delete it, or choose another")
    if find_spec("rerun") is None:
        raise ConfigError("view: recordings for Rerun need `pip install 'phd_exp[rerun]'`")
    with writing(view, "view=", ConfigError):
        view.parent.mkdir(parents=True, exist_ok=True)


def places(out: Path | None, view: Path | None, inputs: Iterable[Path], name: str) -> None:
    """Prepare out=, a recording or a folder, and view=, a new recording for Rerun.

    The message about a folder suggests the recording `name`.mcap inside it.

    Raises ConfigError if an output cannot be written, is an input or holds one.
    """
    if out is not None and out.suffix == MCAP:
        require_output(out, f"{name}{MCAP}", inputs)
    elif out is not None:
        if out.resolve() in {path if path.is_dir() else path.parent for path in map(Path.resolve, inputs)}:
            raise ConfigError(f"out={out}: holds the images themselves; choose another folder")
        output_folder(out)
    if view is not None:
        new_view(view)

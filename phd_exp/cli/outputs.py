"""Outputs of out= and view=: prepared, or refused, before anything is computed.

An output is a new name, or a plain file of the kind that the verb writes; a link may lead to it. It is none of the
files that the command reads, and not in the run's folder. A folder keeps all files that this program did not write.
"""

import os
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import Any

from phd_exp.cli.arguments import Arguments
from phd_exp.records.errors import ConfigError, writing
from phd_exp.records.files import beginning, make_folder
from phd_exp.records.messages import MessageFile, require_rosbags
from phd_exp.records.recordings import MCAP, is_recording
from phd_exp.records.written import Written

KINDS = {
    ".onnx": rb"\x08",  # the field of the version
    ".zip": rb"PK\x03\x04.{26}README\.md",  # of `pack`, where the card comes first
    ".jsonl": rb'\{"scene": ',
    ".parquet": rb"PAR1",
    ".rrd": rb"RRF",
    MCAP: rb"\x89MCAP0\r\n",
}
"""Suffix of an output -> how files of this kind begin."""


def output_folder(out: Path, key: str = "out") -> None:
    """Make a folder to write into. Raises ConfigError if that is impossible."""
    with writing(out, f"{key}=", ConfigError):
        make_folder(out)


def require_output(out: Path, name: str, arguments: Arguments, inputs: Iterable[Path] = (), key: str = "out") -> None:
    """Judge an output file of the kind of `name`, which messages suggest, before its folder is made.

    Raises ConfigError if the file is of another kind, is read, lies in a recording that is read, lies in the run's
    folder and is not `name` there, or if the package that writes it is missing.
    """
    if out.is_dir():
        raise ConfigError(f"{key}={out}: is a folder; expected a file, such as {out / name}")
    try:
        start = beginning(out)
    except OSError as error:
        fault, _, _ = str(error.strerror).partition(";")
        raise ConfigError(f"{key}={out}: {fault}; expected a new file, such as {name}") from None
    _require_apart(out, [out, _place(out).parent], arguments, inputs, key, name)
    if start and not re.match(KINDS[Path(name).suffix], start, re.DOTALL):
        raise ConfigError(
            f"{key}={out}: holds other data than this command writes; expected a new file, such as {name}; move the "
            "old one away, or choose another name"
        )
    if name.endswith(MCAP):
        require_rosbags(key)


def _place(path: Path) -> Path:
    """The absolute path behind all links."""
    return Path(os.path.realpath(path))


def _require_apart(
    out: Path, files: Iterable[Path], arguments: Any, inputs: Iterable[Path], key: str = "out", own: str | None = None
) -> None:
    """Raise ConfigError if one of an output's files is read or lies in a recording that is.

    Raises ConfigError too if the output is or lies in the folder of the run, and is not the file `own` there.
    """
    others = [value for word, value in arguments if word not in ("out", "view")]
    named = chain(*(value if isinstance(value, tuple) else (value,) for value in others))
    paths = [Path(word) for word in named if isinstance(word, str | Path) and os.path.exists(word)]
    read = {_place(path) for path in (*paths, *inputs) if path.is_file() or is_recording(path)}
    if read & set(map(_place, files)):
        raise ConfigError(
            f"{key}={out}: is one of the files that are read, or lies in the recording; choose another place"
        )
    run, place = getattr(arguments, "run", ()), _place(out)
    for folder in map(_place, run if isinstance(run, tuple) else (run,)):
        if folder.is_dir() and place.is_relative_to(folder) and not (own and place == folder / own):
            raise ConfigError(f"{key}={out}: lies in the run's folder; choose another place")


@contextmanager
def message_file(out: Path | None) -> Iterator[MessageFile | None]:
    """The recording that out= names, open for writing; None if out= names no recording."""
    if out is None or out.suffix != MCAP:
        yield None
        return
    with MessageFile(_place(out)) as messages:
        yield messages


def new_view(view: Path, arguments: Arguments, inputs: Iterable[Path] = ()) -> None:
    """Make the folder of a recording for Rerun. Raises ConfigError unless `view` is an output *.rrd."""
    if view.suffix != ".rrd":
        raise ConfigError(f"view: got {view}; expected a file *.rrd, such as {view.with_name('view.rrd')}")
    require_output(view, "view.rrd", arguments, inputs, "view")
    if find_spec("rerun") is None:
        raise ConfigError("view: recordings for Rerun need `pip install 'phd_exp[rerun]'`")
    output_folder(view.parent, "view")


def places(arguments: Any, inputs: Sequence[Path], name: str, files: Sequence[str]) -> None:
    """Prepare out=, a recording or a folder for these `files`, and view=, a recording for Rerun.

    `name` names the recording in messages, and the list of what is written to the folder.

    Raises ConfigError if an output cannot be written, is an input or holds one, or if others wrote one of the files.
    """
    out: Path | None = arguments.out
    if out is not None and out.suffix == MCAP:
        require_output(out, f"{name}{MCAP}", arguments, inputs)
        output_folder(out.parent)
    elif out is not None:
        if _place(out) in {path if path.is_dir() else path.parent for path in map(_place, inputs)}:
            raise ConfigError(f"out={out}: holds the images themselves; choose another folder")
        _require_apart(out, [out / file for file in files], arguments, inputs)
        output_folder(out)
        with writing(out, "out=", ConfigError):
            Written(out, name).require(*files)
    if arguments.view is not None:
        new_view(arguments.view, arguments, inputs)

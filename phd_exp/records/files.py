"""Files that are whole or absent: atomic writing, and journals that survive being cut off."""

import json
import os
import uuid
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO, TypeVar

from phd_exp.records.errors import UserError

Parsed = TypeVar("Parsed")

TEMPORARY_SUFFIX = ".tmp"


class CorruptFileError(UserError):
    """A file on disk does not hold what its schema promises; the message names file and line."""


def write_atomic(path: Path | str, data: bytes | str) -> None:
    """Write `data` to `path` so that a reader finds the old content or the new, never a part.

    The bytes go to a hidden temporary file in the same folder (a rename is atomic within one file system
    only), reach the disk, and then take the name. The temporary file is removed if anything fails.

    Raises:
        OSError: the folder is missing or unwritable, or the disk is full; `path` is then unchanged.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}{TEMPORARY_SUFFIX}")
    try:
        with open(temporary, "xb") as stream:
            stream.write(data.encode() if isinstance(data, str) else data)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise


def remove_temporaries(folder: Path) -> None:
    """Remove what `write_atomic` left in `folder` when its process was killed half-way."""
    for leftover in folder.glob(f".*{TEMPORARY_SUFFIX}"):
        leftover.unlink(missing_ok=True)


def open_journal(path: Path) -> TextIO:
    """Open an append-only file of lines; each line written reaches the system at once.

    A torn last line, left by a killed writer, is cut off first: the next line would otherwise be glued to it.

    Raises:
        OSError: the file cannot be created, read or written.
    """
    with open(path, "a+b") as stream:
        stream.seek(0)
        whole = stream.read()
        complete = whole.rfind(b"\n") + 1
        if complete < len(whole):
            stream.truncate(complete)
    return open(path, "a", encoding="utf-8", buffering=1)


def read_jsonl(
    path: Path, parse: Callable[[str], Parsed] = json.loads, *, limit: int | None = None, sealed: bool = False
) -> list[Parsed]:
    """Read the first `limit` lines of a file of JSON lines (all of them by default), each through `parse`.

    A last line without its line end is what a killed writer left, and is ignored. A `sealed` file was written
    in one piece, so that there, and on any other line anywhere, what does not parse is an error.

    Raises:
        CorruptFileError: naming the file and the line.
        OSError: the file cannot be read.
    """
    lines = path.read_bytes().split(b"\n")
    unfinished = lines.pop()
    if unfinished and sealed:
        lines.append(unfinished)
    return [_parse_line(path, number, line, parse) for number, line in enumerate(lines[:limit], start=1)]


def _parse_line(path: Path, number: int, line: bytes, parse: Callable[[str], Any]) -> Any:
    try:
        return parse(line.decode())
    except (
        ValueError
    ) as error:  # JSONDecodeError, UnicodeDecodeError and pydantic's ValidationError are all this
        raise CorruptFileError(f"{path}, line {number}: not a valid record ({_brief(error)})") from error


def _brief(error: ValueError) -> str:
    """The gist of an error on one line: pydantic prints a heading, the key, the complaint and a link."""
    return " ".join(line.strip() for line in str(error).splitlines()[:3])[:200]

"""Files that are whole or absent: atomic writing, and journals that survive being cut off."""

import errno
import fcntl
import os
import re
import stat
import uuid
from collections.abc import Callable
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any, TextIO, TypeVar

from phd_exp.records.errors import CorruptFileError, gist
from phd_exp.records.parsing import parse_json

Parsed = TypeVar("Parsed")

_TEMPORARY = re.compile(r"\..+\.[0-9a-f]{32}\.tmp", re.DOTALL)
"""What `write_atomic` calls a file that has not its name yet."""
MB = 10**6
LARGEST_RECORD = 16 * MB
"""Bytes of a file that is read whole; the longest that are written here have a few thousand."""
LONGEST_LINE = MB
"""Bytes of a line of a journal; a sample's has about two thousand."""


def require_plain(path: Path, largest: int | None = None) -> None:
    """Raise OSError unless a path leads to a plain file, of at most so many bytes.

    A pipe would be waited for without end, and a device has no end: files of somebody else may be either.
    """
    found = os.stat(path)
    if stat.S_ISDIR(found.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(found.st_mode):
        raise OSError(errno.EINVAL, "a pipe or a device; expected a plain file", str(path))
    if largest is not None and found.st_size > largest:
        size = f"{found.st_size / MB:.0f} MB; expected at most {largest / MB:.0f} MB"
        raise OSError(errno.EFBIG, size, str(path))


def read_plain(path: Path, largest: int = LARGEST_RECORD) -> bytes:
    """The bytes of a plain file. Raises OSError as `require_plain` does, and where it cannot be read."""
    require_plain(path, largest)
    return path.read_bytes()


def write_atomic(path: Path | str, data: bytes | str) -> None:
    """Write `data` to `path` so that a reader finds the old content or the new, never a part.

    The bytes go to a hidden temporary file in the same folder (a rename is atomic within one file system
    only), reach the disk, and then take the name. The temporary file is removed if anything fails. It is locked as
    long as its writer lives, which tells `remove_temporaries` what a killed one left.

    Raises:
        OSError: the folder is missing or unwritable, or the disk is full; `path` is then unchanged.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        with open(temporary, "xb") as stream:
            with suppress(OSError):  # a file system without locks, where nothing is removed either
                fcntl.flock(stream, fcntl.LOCK_SH)
            stream.write(data.encode() if isinstance(data, str) else data)
            stream.flush()
            os.fsync(stream.fileno())
            os.replace(temporary, path)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        # a write into an open file does not say which
        if isinstance(error, OSError) and error.filename is None:
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def remove_temporaries(folder: Path) -> None:
    """Remove what `write_atomic` left in `folder` when its process was killed half-way."""
    for path in folder.glob(".*.tmp"):
        if _TEMPORARY.fullmatch(path.name) and path.is_file() and not path.is_symlink():
            with suppress(OSError):  # its writer lives, or has renamed it since
                _remove_unless_locked(path)


def _remove_unless_locked(path: Path) -> None:
    with open(path, "r+b") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        path.unlink()


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
    path: Path,
    parse: Callable[[str], Parsed] = parse_json,
    *,
    limit: int | None = None,
    sealed: bool = False,
) -> list[Parsed]:
    """Read the first `limit` lines of a file of JSON lines (all of them by default), each through `parse`.

    A last line without its line end is what a killed writer left, and is ignored. A `sealed` file was written
    in one piece, so that there, and on any other line anywhere, what does not parse is an error.

    Raises:
        CorruptFileError: naming the file and the line.
        OSError: the file cannot be read, or is no plain file.
    """
    require_plain(path)
    records: list[Parsed] = []
    with open(path, "rb") as stream:
        for number in count(1) if limit is None else range(1, limit + 1):
            line = stream.readline(LONGEST_LINE + 1)
            if len(line) > LONGEST_LINE:
                raise CorruptFileError(f"{path}, line {number}: longer than {LONGEST_LINE} bytes")
            if not line.endswith(b"\n") and not (line and sealed):
                break
            records.append(_parse_line(path, number, line.removesuffix(b"\n"), parse))
    return records


def _parse_line(path: Path, number: int, line: bytes, parse: Callable[[str], Any]) -> Any:
    try:
        return parse(line.decode())
    except ValueError as error:  # also UnicodeDecodeError and pydantic's ValidationError
        raise CorruptFileError(f"{path}, line {number}: not a valid record ({gist(error)})") from error

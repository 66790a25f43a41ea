"""Files that are whole or absent, and lines of which a killed writer tears the last one at most."""

import errno
import fcntl
import hashlib
import os
import shutil
import stat
import uuid
from collections.abc import Callable, Iterable
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import TypeVar

from phd_exp.records.errors import CorruptFileError, gist
from phd_exp.records.parsing import parse_json

Parsed = TypeVar("Parsed")

TEMPORARY = ".phd_exp.tmp"  # ends the names of temporary files and folders, which nobody else gives
MB = 10**6
LARGEST_RECORD = 16 * MB  # bytes of a file that is read as a whole; the project's own files have a few thousand
LONGEST_LINE = MB  # bytes of a line of a journal; the line of a sample has about two thousand


def require_plain(path: Path, largest: int | None = None) -> None:
    """Raise OSError unless a path leads to a plain file of at most `largest` bytes.

    Reading a pipe could wait for ever, and a device may never end; a stranger's file may be either.
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
    """The bytes of a plain file. Raises OSError if it cannot be read, or as `require_plain` does."""
    require_plain(path, largest)
    return path.read_bytes()


def checksum(path: Path) -> str:
    """SHA-256 of a plain file of any size. Raises OSError if it cannot be read."""
    require_plain(path)
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def beginning(path: Path, n: int = 64) -> bytes:
    """The first bytes of the file at an output's place; empty if it is new, also where a link leads.

    Raises OSError if a folder, a pipe or a device is there, or links go round.
    """
    with suppress(FileNotFoundError):
        require_plain(path)
        with open(path, "rb") as stream:
            return stream.read(n)
    return b""


def make_folder(folder: Path) -> None:
    """Make a folder to write into, without the temporary files of killed processes. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    remove_temporaries(folder)


def write_atomic(path: Path | str, data: bytes | str | Iterable[bytes]) -> None:
    """Write `data`, in parts if it is large, to `path` so that a reader finds either the old content or the new.

    The bytes are written to a hidden temporary file in the same folder (a rename is atomic within one file system
    only), flushed to the disk, and renamed. The temporary file is removed on any failure. It is locked while its
    writer lives, so that `remove_temporaries` recognises those of killed writers. A link stays: what it leads to is
    written.

    Raises OSError if the folder is missing or unwritable, the disk is full, or `path` is neither new nor a plain
    file; it is then unchanged.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     write_atomic(Path(folder, "notes"), "whole or absent")
        ...     Path(folder, "notes").read_text()
        'whole or absent'
    """
    beginning(path := Path(path), 0)
    place = Path(os.path.realpath(path))
    temporary = place.with_name(f".{place.name}.{uuid.uuid4().hex[:16]}{TEMPORARY}")
    try:
        with open(temporary, "xb") as stream:
            with suppress(OSError):  # on a file system without locks, nothing is removed later either
                fcntl.flock(stream, fcntl.LOCK_SH)
            parts = data.encode() if isinstance(data, str) else data
            stream.writelines([parts] if isinstance(parts, bytes) else parts)
            stream.flush()
            os.fsync(stream.fileno())
            os.replace(temporary, place)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        # an error of an open file does not name it
        if isinstance(error, OSError) and error.filename is None:
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def remove_temporaries(folder: Path) -> None:
    """Remove the temporary files and folders in `folder` that killed writers left."""
    for path in folder.glob(f".?*{TEMPORARY}"):
        if (path.is_file() or path.is_dir()) and not path.is_symlink():
            with suppress(OSError):  # its writer lives, or has renamed it since
                descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
                try:
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    shutil.rmtree(path) if path.is_dir() else path.unlink()
                finally:
                    os.close(descriptor)


def read_jsonl(
    path: Path, parse: Callable[[str], Parsed] = parse_json, *, limit: int | None = None, sealed: bool = False
) -> list[Parsed]:
    """Parse the first `limit` lines of a file of JSON lines, all by default.

    A last line without a line end is ignored: a killed writer left it. A `sealed` file was written as a whole; its
    last line is parsed too.

    Raises:
        CorruptFileError: a line cannot be parsed; names the file and the line.
        OSError: the file cannot be read, or is no plain file.
    """
    require_plain(path)
    records: list[Parsed] = []
    with open(path, "rb") as stream:
        for number in count(1) if limit is None else range(1, limit + 1):
            line = stream.readline(LONGEST_LINE + 1)
            if not line.endswith(b"\n") and not (line and sealed) and len(line) <= LONGEST_LINE:
                break
            try:
                if len(line) > LONGEST_LINE:
                    raise ValueError(f"longer than {LONGEST_LINE} bytes")
                records.append(parse(line.removesuffix(b"\n").decode()))
            except ValueError as error:  # also UnicodeDecodeError and pydantic's ValidationError
                raise CorruptFileError(f"{path}, line {number}: not a valid record ({gist(error)})") from error
    return records

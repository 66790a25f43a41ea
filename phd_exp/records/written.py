"""Which files of a folder this program wrote: a repeated command replaces these alone, whatever else lies there."""

import errno
import hashlib
import json
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from phd_exp.records.errors import CorruptFileError
from phd_exp.records.files import checksum, make_folder, read_jsonl, write_atomic
from phd_exp.records.processes import announce


class Written:
    """The files that a command writes into a folder, and those that earlier commands wrote there.

    A hidden file of lines has the name of each file and its checksum, or None for a file that is written in parts. At
    the end of a command without an error, the earlier files that it did not write again are removed.

    Args:
        folder: may hold files of others.
        name: of the list, since other commands may use the folder too.

    Raises CorruptFileError if the list is damaged, OSError if it cannot be read.
    """

    def __init__(self, folder: Path, name: str) -> None:
        self.folder, self._list = folder, folder / f".{name}.written"
        self._earlier, self._now = self._listed(), dict[str, str | None]()
        self._clean: set[Path] = set()

    def _listed(self) -> dict[str, set[str | None]]:
        found: dict[str, set[str | None]] = {}
        with suppress(FileNotFoundError):
            lines: list[Any] = read_jsonl(self._list)
            for line in lines:
                match line:
                    case [str(name), str() | None as digest]:
                        found.setdefault(name, set()).add(digest)
                    case _:
                        raise CorruptFileError(f"{self._list}: not a list of written files; choose another folder")
        return found

    def require(self, *names: str) -> None:
        """Raise OSError if one of these files is there and was written or changed by others, or is no plain file."""
        for name in names:
            path = self.folder / name
            with suppress(FileNotFoundError):
                if name not in self._now and not self._is_own(name, path):
                    raise FileExistsError(errno.EEXIST, "holds a file that phd_exp did not write", str(path))

    def _is_own(self, name: str, path: Path) -> bool:
        return bool({checksum(path), None} & self._earlier.get(name, set()))

    def place(self, name: str) -> Path:
        """The path of a file that the caller writes in parts. Raises OSError as `require`."""
        self._begin(name, None)
        return self.folder / name

    def write(self, name: str, content: bytes | str) -> None:
        """Write a file as a whole. Raises OSError as `require`, or if it cannot be written."""
        data = content.encode(errors="replace") if isinstance(content, str) else content
        self._begin(name, hashlib.sha256(data).hexdigest())
        write_atomic(self.folder / name, data)

    def _begin(self, name: str, digest: str | None) -> None:
        self.require(name)
        if (parent := (self.folder / name).parent) not in self._clean:
            make_folder(parent)
            self._clean.add(parent)
        self._note(name, digest)

    def _note(self, name: str, digest: str | None) -> None:
        self._now[name] = digest
        self._journal.write(json.dumps([name, digest]) + "\n")

    def __enter__(self) -> Self:
        make_folder(self.folder)
        # anew, without the last line that a killed command left incomplete
        self._store((name, digest) for name, each in self._listed().items() for digest in each)
        self._journal = open(self._list, "a", encoding="utf-8", buffering=1)  # a line is on disk once it is written
        return self

    def _store(self, entries: Iterable[tuple[str, str | None]]) -> None:
        write_atomic(self._list, "".join(json.dumps(entry) + "\n" for entry in entries))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, place: TracebackType | None
    ) -> None:
        with suppress(OSError), self._journal:  # a file whose end is not noted remains known
            for name in [name for name, digest in self._now.items() if digest is None]:
                self._note(name, checksum(self.folder / name))
        if kind is not None:
            return
        removed = [name for name in self._earlier.keys() - self._now.keys() if self._remove(name)]
        others = ((name, one) for name, each in self._listed().items() for one in each if name not in self._earlier)
        entries = dict(others) | self._now  # others: of a command at the same time
        self._store(entries.items())
        replaced = self._earlier.keys() & self._now.keys()
        if removed or replaced:
            announce(f"{self.folder}: of an earlier command, {len(replaced)} files replaced, {len(removed)} removed")

    def _remove(self, name: str) -> bool:
        """Remove a file of an earlier command, unless others changed it or a link leads out of the folder."""
        path = self.folder / name
        with suppress(OSError):
            is_inside = path.resolve().is_relative_to(self.folder.resolve()) and not path.is_symlink()
            if is_inside and self._is_own(name, path):
                path.unlink()
                return True
        return False

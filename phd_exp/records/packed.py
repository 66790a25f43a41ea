"""A run as one file to share: an uncompressed zip archive of the files that predictions need.

    run.zip
        README.md            the card: figures with their conditions, data, licence, use
        checkpoints/last.ckpt    the weights of the network alone
        config.yaml, constants.json, status.json, results.json, metrics.jsonl
        predictions.parquet, held_out.parquet, eight_views_*.parquet, views.parquet
        labelled/*.parquet, sequences/*.parquet

Equal content has equal bytes. An archive may come from a stranger: it holds files of these names and no others, each
once, uncompressed, so that together they are no larger than the archive. They are written to a temporary folder,
which is removed when it is no longer used.
"""

import io
import re
import shutil
import stat
import tempfile
import weakref
from collections.abc import Iterator, Mapping
from pathlib import Path
from zipfile import ZIP_STORED, ZipFile, ZipInfo

from phd_exp.records.errors import RunError, reading, shown
from phd_exp.records.files import MB, require_plain, write_atomic
from phd_exp.records.runs import RunFolder

CARD = "README.md"
WEIGHTS = "checkpoints/last.ckpt"
RECORDS = ("config.yaml", "constants.json", "status.json", "results.json", "metrics.jsonl")
TABLES = (
    r"(predictions|held_out|eight_views_(held_out|test)|views|labelled/[A-Za-z0-9][\w-]*|sequences/[\w-]+)\.parquet"
)
NAMES = re.compile("|".join(map(re.escape, (CARD, WEIGHTS, *RECORDS))) + f"|{TABLES}", re.ASCII)
LARGEST = 4000 * MB  # bytes of an archive, whose format without extensions ends at 4 GiB
MOST_FILES = 1000
LARGEST_LIST = MB // 4  # bytes of the list of files at the end of an archive
EXAMPLES = Path(__file__).parents[1] / "examples"
END, END_OF_LARGE = b"PK\x05\x06", b"PK\x06\x07"  # signatures of the format


def recorded_files(run: RunFolder) -> Iterator[tuple[str, Path]]:
    """The files of a run that are packed, except the weights, by their names, in order.

    Raises RunError for a link, which in a stranger's run may lead to a file of yours.
    """
    for path in sorted([*run.path.glob("*"), *run.path.glob("labelled/*"), *run.path.glob("sequences/*")]):
        name = path.relative_to(run.path).as_posix()
        if name != CARD and NAMES.fullmatch(name):
            if path.is_symlink() or (path.parent != run.path and path.parent.is_symlink()):
                raise RunError(f"{path}: is a link; put the file or folder itself in its place")
            yield name, path


def write_packed(file: Path, contents: Mapping[str, bytes]) -> None:
    """Write files by name as an archive. Raises RunError if it would be too large, OSError as `write_atomic`."""
    if sum(map(len, contents.values())) > LARGEST:
        raise RunError(f"{file}: would have more than {LARGEST // MB} MB; expected at most that much")
    archive = io.BytesIO()
    with ZipFile(archive, "w", ZIP_STORED) as stream:
        for name, content in contents.items():
            entry = ZipInfo(name)  # of 1980
            entry.create_system, entry.external_attr = 3, (stat.S_IFREG | 0o644) << 16
            stream.writestr(entry, content)
    write_atomic(file, archive.getvalue())


def or_example(path: Path) -> Path:
    """The path, or what comes with the package by this name if nothing is there: `cylinder`, `cylinder.png`."""
    found = [file for name in (path.name, f"{path.name}.zip") if (file := EXAMPLES / name).is_file()]
    return found[0] if found and path == Path(path.name) and not path.exists() else path


def opened(path: Path) -> RunFolder:
    """The run of a folder, or of an archive; the files of an archive are there as long as the run is used.

    Raises RunError, one line, for any other file.
    """
    if not path.is_file():
        return RunFolder(path)
    outer = Path(tempfile.mkdtemp(prefix="phd_exp-"))
    folder = RunFolder(outer / path.name)
    weakref.finalize(folder, shutil.rmtree, outer, ignore_errors=True)
    with reading(path, "expected a file of `pack`", RunError, "not the archive of a run"):
        _unpack(path, folder.path)
    return folder


def _unpack(file: Path, folder: Path) -> None:
    """Write the files of an archive below a folder. Raises ValueError, OSError or an error of `zipfile`."""
    require_plain(file, LARGEST)
    _require_short_list(file)
    with ZipFile(file) as archive:
        entries = archive.infolist()
        _require_known(entries, file.stat().st_size)
        for entry in entries:
            path = folder / entry.filename
            path.parent.mkdir(parents=True, exist_ok=True)
            with archive.open(entry) as source, open(path, "xb") as copy:
                shutil.copyfileobj(source, copy)


def _require_short_list(file: Path) -> None:
    """Refuse an archive whose list of files is long, before it is read into memory."""
    with open(file, "rb") as stream:
        stream.seek(max(0, stream.seek(0, io.SEEK_END) - 42))
        last = stream.read()
    end = last[-22:]
    if not end.startswith(END) or end[-2:] != b"\0\0" or last.startswith(END_OF_LARGE):
        raise ValueError("its end is no end of a plain zip archive")
    size = int.from_bytes(end[12:16], "little")
    if size > LARGEST_LIST:
        raise ValueError(f"its list of files has {size} bytes; expected at most {LARGEST_LIST}")


def _require_known(entries: list[ZipInfo], size: int) -> None:
    """Refuse entries that `write_packed` does not write."""
    names = [entry.filename for entry in entries]
    if len(names) > MOST_FILES:
        raise ValueError(f"{len(names)} files; expected at most {MOST_FILES}")
    for entry in entries:
        if not NAMES.fullmatch(entry.filename):
            raise ValueError(f"{shown(entry.filename)} is not a file of a packed run")
        if names.count(entry.filename) > 1:
            raise ValueError(f"{entry.filename} is given twice")
        if stat.S_IFMT(entry.external_attr >> 16) not in (0, stat.S_IFREG):
            raise ValueError(f"{entry.filename} is a link or a device; expected a plain file")
        if entry.compress_type != ZIP_STORED or entry.compress_size != entry.file_size or entry.flag_bits & 1:
            raise ValueError(f"{entry.filename} is compressed or encrypted; expected it as it is")
    if sum(entry.file_size for entry in entries) > size:
        raise ValueError("its files together are larger than the archive; expected files that do not overlap")

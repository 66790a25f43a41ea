"""Archives of runs that `pack` does not write: damaged ones, and those of an attacker."""

import io
import stat
import struct
import warnings
from collections.abc import Callable
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile, ZipInfo

import yaml

from phd_exp.records.packed import NAMES
from tests.bad_input.bad import Bad
from tests.bad_input.place import Place

PACKED = ("predict", "run=run.zip", "image=photos/test/0.png", "f=300")
Entry = tuple[str | ZipInfo, bytes]


def sound(place: Place) -> list[Entry]:
    """The files of the place's run, as an archive has them."""
    files = sorted(path for path in place.run.path.rglob("*") if path.is_file())
    found = [(path.relative_to(place.run.path).as_posix(), path.read_bytes()) for path in files]
    return [(name, content) for name, content in found if NAMES.fullmatch(name)]


def zipped(entries: list[Entry], compression: int = ZIP_STORED) -> bytes:
    stream = io.BytesIO()
    with warnings.catch_warnings(), ZipFile(stream, "w", compression) as archive:
        warnings.simplefilter("ignore", UserWarning)  # of names that are given twice
        for entry, content in entries:
            archive.writestr(entry, content)
    return stream.getvalue()


def packed(name: str, make: Callable[[list[Entry]], bytes], said: str, status: int = 1) -> Bad:
    def spoil(place: Place) -> None:
        place.put("run.zip", make(sound(place)))

    return Bad(f"packed run: {name}", spoil, PACKED, said, status)


def refused(name: str, make: Callable[[list[Entry]], bytes], reason: str) -> Bad:
    return packed(name, make, rf"run\.zip: not the archive of a run \({reason}\); expected a file of `pack`")


def with_file(name: str | ZipInfo, content: bytes = b"touch owned") -> Callable[[list[Entry]], bytes]:
    return lambda entries: zipped([*entries, (name, content)])


def link(target: bytes) -> Entry:
    entry = ZipInfo("held_out.parquet")
    entry.create_system, entry.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
    return entry, target


def without(entries: list[Entry], name: str) -> list[Entry]:
    return [entry for entry in entries if entry[0] != name]


def overlapping(entries: list[Entry]) -> bytes:
    """Five hundred files whose bytes are those of the first."""
    content = zipped([("metrics.jsonl", b" " * 100_000)])
    start = content.index(b"PK\x01\x02")
    one = bytearray(content[start : content.index(b"PK\x05\x06")])
    names = [f"labelled/{number:05}.parquet".encode() for number in range(500)]
    listed = b"".join(bytes(one[:28]) + struct.pack("<H", len(name)) + bytes(one[30:46]) + name for name in names)
    end = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, len(names), len(names), len(listed), start, 0)
    return content[:start] + listed + end


def understated(entries: list[Entry]) -> bytes:
    """A file of eight megabytes of zeros, whose entry says that it has as many bytes as it takes when compressed."""
    content = bytearray(zipped([("metrics.jsonl", b"\0" * 8_000_000)], ZIP_DEFLATED))
    start = content.index(b"PK\x01\x02")
    (size,) = struct.unpack_from("<L", content, start + 20)
    struct.pack_into("<L", content, start + 24, size)
    for place in (8, start + 10):
        struct.pack_into("<H", content, place, ZIP_STORED)
    return bytes(content)


def damaged(entries: list[Entry]) -> bytes:
    content = bytearray(zipped(entries))
    content[content.index(b"mu_z0")] ^= 1
    return bytes(content)


def foreign(target: str) -> Callable[[list[Entry]], bytes]:
    def make(entries: list[Entry]) -> bytes:
        config = yaml.safe_load(dict(entries)["config.yaml"])
        config["backbone"] = {"_target_": target, "command": "touch owned"}
        return zipped([*without(entries, "config.yaml"), ("config.yaml", yaml.safe_dump(config).encode())])

    return make


def long_list(entries: list[Entry]) -> bytes:
    return zipped([(f"labelled/{'a' * 200}{number}.parquet", b"") for number in range(2000)])


def of_many(entries: list[Entry]) -> bytes:
    return zipped([(f"labelled/{number}.parquet", b"") for number in range(1001)])


def large_end(entries: list[Entry]) -> bytes:
    content = zipped(entries)
    return content[:-22] + struct.pack("<4sLQL", b"PK\x06\x07", 0, 0, 1) + content[-22:]


def encrypted(entries: list[Entry]) -> bytes:
    content = bytearray(zipped(entries))
    content[content.rindex(b"PK\x01\x02") + 8] |= 1
    return bytes(content)


NOT_OURS = "is not a file of a packed run"
ARCHIVES = [
    refused("no archive", lambda entries: b"no archive at all" * 10, "its end is no end of a plain zip archive"),
    refused("a longer end", large_end, "its end is no end of a plain zip archive"),
    refused("damaged", damaged, "Bad CRC-32 for file .*"),
    refused("a path that leads up", with_file("../owned"), rf"'\.\./owned' {NOT_OURS}"),
    refused("a path that leads up within", with_file("labelled/../../owned"), rf"'labelled/.*' {NOT_OURS}"),
    refused("an absolute path", with_file("/tmp/owned"), rf"'/tmp/owned' {NOT_OURS}"),
    refused("a path of another system", with_file("..\\owned"), rf"'\.\.\\\\owned' {NOT_OURS}"),
    refused("a name that steers the terminal", with_file("\x1b[2J"), rf"'\\x1b\[2J' {NOT_OURS}"),
    refused("a link", lambda entries: zipped([*entries, link(b"/etc/passwd")]), r"held_out\.parquet is a link .*"),
    refused("a name twice", with_file("config.yaml"), r"config\.yaml is given twice"),
    refused("compressed", lambda entries: zipped(entries, ZIP_DEFLATED), r".* is compressed or encrypted; .*"),
    refused("encrypted", encrypted, r".* is compressed or encrypted; .*"),
    refused("sizes that are false", understated, r".*(CRC-32|compressed).*"),
    refused("files that overlap", overlapping, r"its files together are larger than the archive; .*"),
    refused("a list without end", long_list, r"its list of files has \d+ bytes; expected at most 250000"),
    refused("many files", of_many, r"1001 files; expected at most 1000"),
    packed("no configuration", lambda entries: zipped(without(entries, "config.yaml")), r".*run\.zip: no run; .*"),
    packed("no weights", lambda entries: zipped(without(entries, "checkpoints/last.ckpt")), r".*last\.ckpt: missing; .*"),
    packed("code for weights", lambda entries: zipped([*without(entries, "checkpoints/last.ckpt"), ("checkpoints/last.ckpt", b"\x80\x04cos\nsystem\n")]), r".*last\.ckpt: not a whole checkpoint .*"),
    packed("a foreign target", foreign("os.system"), r"backbone\._target_: 'os\.system' is not built from a stored configuration.*", 2),
]  # fmt: skip

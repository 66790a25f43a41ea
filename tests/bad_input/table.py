"""A mistake or an attack of each kind: what is wrong, the command that meets it, and the words of its one line."""

import io
import json
import stat
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile, ZipInfo

import torch

from phd_exp.records.packed import NAMES
from tests.bad_input import images
from tests.bad_input.place import LEARN, ONE, PREDICT, VERIFY, Place
from tests.support.foreign import WRITERS

TYPED = {
    "data.ntrain=3": "data.ntrain: unknown key, did you mean 'data.n_train'?; expected one of n_train, ",
    "epochs=3": "epochs: unknown key, did you mean 'trainer.max_epochs'?; expected one of backbone, ",
    "modle=mae_vz": "did you mean 'model'",
    "model=mae_log": "model=mae_log: no such choice, did you mean 'mae_logz'?; expected one of ",
    "data.folder=photos": "data.folder: not a key of this choice, but of data=folder; name that choice too",
    "trainer.gradient_clip_val=1": "of its class has a plus sign: +trainer.gradient_clip_val=VALUE",
    "-m hydra/launcher=submitit_slurm hydra.launcher.partiton=x": "did you mean 'hydra.launcher.partition'?",
    "network.width=8": "network.width: set by presets and recipes; expected the key of the run",
    "model = mae_vz": "model: no KEY=VALUE, did you mean ",
    "data.n_train=[": "data.n_train=[: ",
    "--nonsense": "unrecognized arguments: --nonsense; see `python -m phd_exp --help`",
    "--cfg\r": "--cfg: holds control characters",
    "runs=r\udcff": "is not UTF-8",
    "model=null": "Config group override must be a string or a list",
    "seed=${nope}": "Interpolation key 'nope' not found",
    "model.name='a\\${b}'": "model.name: got 'a${b}'; expected a value, since no interpolation is evaluated here",
    "optimizer.lr=inf": "optimizer.lr: got inf; expected to be a finite number",
    "+loss._partial_=3": "loss._partial_: got 3; expected a bool",
    "init=nowhere": "init: got nowhere; expected the folder of a finished run",
    "+evaluation.shifts.a.data.z_range=[5,4]": "evaluation.shifts.a.data: z_range: got [5, 4]",
    "experiment=table1": "experiment=table1: names several runs; write -m before it: -m ",
    "-m experiment=tabel2": "experiment=tabel2: no such choice, did you mean 'table2'?",
    "-m experiment=ablation optimizer=adam": "optimizer.weight_decay: not a key of this choice, but of ",
    "-m experiment=glob(nothing*)": "not one combination; does a glob(...) match nothing?",
    "-m seed=range(0,1e9)": "more than 10000 jobs",
    "runs=file/runs": "file",
}
"""Words after `preset=smoke logger=none`, and a part of the line that they cause."""
VIEW = {"file_name": "0.png", "f": 300, "scene": 1, "pose": {"rotation": [1, 0, 0, 0], "translation": [0, 0, 0]}}
FUSE = ("fuse", "run=nowhere", "folder=photos/test")
ARGUMENTS = {
    (*ONE, "imag=good.png"): "imag: unknown key, did you mean 'image'?; predict takes ",
    ("predict", "run=RUN", "good.png"): "good.png: expected key=value",
    (*ONE, "run=nowhere"): "run: given twice",
    ("predict", "image=a.png"): "run: missing; predict takes run=",
    (*ONE, "views=3"): "views: got '3'; expected to be '1' or '8'",
    (*ONE, "coverage=nan"): "coverage: got 'nan'; expected to be ",
    (*ONE, "folder=."): "expected either image=FILE",
    (*ONE, "box=1,2,3"): "box: got '1,2,3'; expected box=LEFT,TOP,RIGHT,BOTTOM in pixels",
    (*ONE[:3], "f=1e400"): "f: got inf; expected to be a finite number",
    (*ONE[:3], "camera=no.yaml"): "no.yaml: cannot be read (No such file or directory)",
    (*ONE, "calibration=garden"): "calibration: got garden; expected a name of `calibrate`",
    (*ONE, "coverage=0.9"): "held_out.parquet: missing; held-out samples are needed",
    (*ONE, "out=photos/test/0.png/x"): "photos/test/0.png/x: cannot be written",
    (*PREDICT, "object=1", "f=400"): "object: selects detections",
    ("predict", "run=runs/smoke", *ONE[2:]): "runs/smoke: no run; expected one of the runs below it: runs/smoke/",
    ("calibrate", "run=RUN", "folder=photos/test", "name=a/b"): "name: got 'a/b'",
    ("export", "run=.", "out=."): "out=.: is a folder",
    (*FUSE, "plane=0,0,0,1"): "plane: ",
    ("report", "runs=x"): "x: no such folder; train first, or name another by runs=DIR",
    ("render", "preset=smoke", "verify=true"): "no data set here",
    (*LEARN, "data.folder=nowhere"): "nowhere/train: no such folder",
    ("search", "space.yaml", "trials=1", *LEARN): "data.n_held_out: got 0",
}
"""Commands, and a part of the line that they cause."""


def line(**changes: Any) -> str:
    """A line of metadata with some changes."""
    return json.dumps({"file_name": "0.png", "f": 300} | changes) + "\n"


PHOTO, LINES, LABELS = "photos/test/0.png", "photos/test/metadata.jsonl", "photos/train/metadata.jsonl"
CONFIG, CONSTANTS, CHECKPOINT = "RUN/config.yaml", "RUN/constants.json", "RUN/checkpoints/last.ckpt"
RETRAIN = (*LEARN, "runs=others")
BOMB = "a: &a [x,x]\n" + "".join(
    f"{b}: &{b} [{','.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcd", "bcde", strict=True)
)
MANIFEST = "renders/handmade/manifest.json"
FILES: list[tuple[str, bytes | str | Callable[[Path], Any], tuple[str, ...], str]] = [
    (PHOTO, b"", PREDICT, "cannot be read as an image (of another kind); expected a whole image (PNG, "),
    (PHOTO, images.POSTSCRIPT, PREDICT, "cannot be read as an image (of another kind)"),
    (PHOTO, images.saved(images.noise(32, 32, 3))[:900], PREDICT, "cannot be read as an image ("),
    (PHOTO, images.declared(65535, 65535), PREDICT, "cannot be read as an image (Image size "),
    (PHOTO, images.text_bomb(), PREDICT, "cannot be read as an image (Decompressed data too large"),
    (PHOTO, images.animated(), PREDICT, "holds several pictures; expected one"),
    (PHOTO, images.turned(), PREDICT, "has the EXIF orientation 6"),
    (PHOTO, images.pipe, PREDICT, "cannot be read (a pipe or a device; expected a plain file)"),
    ("photos/train/0.png", images.pipe, RETRAIN, "line 1: "),
    (LINES, "{", PREDICT, "line 1: not JSON ("),
    (LINES, line(box="DEEP").replace('"DEEP"', "[" * 100_000), PREDICT, "line 1: not JSON (nested too deeply)"),
    (LINES, line(f=0).replace("0", "9" * 400, 2), PREDICT, "line 1: not JSON (a whole number of 400 digits)"),
    (LINES, line(x="a" * 2_000_000), PREDICT, "line 1: not a valid record (longer than 1000000 bytes)"),
    (LINES, '{"file_name": "\udcff"', PREDICT, "line 1: not a valid record ("),
    (
        LINES,
        line(file_name="../../secret.png"),
        PREDICT,
        "line 1: file_name='../../secret.png' is no file name (leaves ",
    ),
    (LINES, line(file_name="\x1b[2J.png"), PREDICT, "is no file name"),
    (LINES, line(f=None), PREDICT, "line 1: expected either f, or fx and fy"),
    (LINES, line(x=0, y=0, z=4000), PREDICT, "if these are millimetres, divide them by 1000"),
    (LINES, line(**VIEW | {"pose": {"rotation": [1, 1, 0, 0]}}), FUSE, "pose.rotation: got [1, 1, 0, 0]; "),
    (LINES, line(), FUSE, "line 1: scene or pose is missing"),
    (LABELS, line(x=float("nan")), RETRAIN, "line 1: x: got nan; expected to be a finite number"),
    (LABELS, line(), RETRAIN, "line 1: x, y, z are missing"),
    ("bop", lambda path: WRITERS["bop"](path / "test"), ("predict", "run=RUN", "folder=bop/test", "object=7"), "'7'"),
    (CHECKPOINT, b"torn", ONE, "last.ckpt: not a whole checkpoint ("),
    (CHECKPOINT, b"\x80\x04cos\nsystem\n(S'touch owned'\ntR.", ONE, "last.ckpt: not a whole checkpoint ("),
    (CONFIG, "!!python/object/apply:os.system ['touch owned']", ONE, "could not determine a constructor"),
    (CONFIG, BOMB, ONE, "the alias *a stands for another part"),
    (CONFIG, "a: " + "[" * 20_000, ONE, "cannot be read (nested too deeply)"),
    (CONFIG, "a: " + "b" * 2_000_000, ONE, "cannot be read (2 MB; expected at most 1 MB)"),
    (CONFIG, images.pipe, ONE, "cannot be read (a pipe or a device"),
    (CONSTANTS, '{"mu_z0": -1}', ONE, "constants.json: not the constants of a run ("),
    (MANIFEST, "[" * 100_000, VERIFY, "manifest.json: not a readable manifest ("),
    (MANIFEST, " " * 20_000_000, VERIFY, "20 MB; expected at most 16 MB"),
]
"""A file with its content or its maker, the command that reads it, and a part of the line that this causes."""


class Trap:
    """Unpickled by a careless reader, it writes a file."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __reduce__(self) -> tuple[Any, ...]:
        return exec, (f"open({self.name!r}, 'w').close()",)


def trap(place: Place) -> None:
    place.put_checkpoint(state_dict=Trap("owned"))


def trap_resumed(place: Place) -> None:
    trap(place)
    interrupted(place)


def interrupted(place: Place) -> None:
    place.put_json(place.run.status_file, state="interrupted")


def diverge(place: Place) -> None:
    weights = torch.load(place.run.last_checkpoint, weights_only=True)["state_dict"]
    weights["regressor.last.bias"][0] = torch.nan
    place.put_checkpoint(state_dict=weights)


def repeat(place: Place) -> None:
    """A small file that names large weights."""
    weights = torch.load(place.run.last_checkpoint, weights_only=True)["state_dict"]
    place.put_checkpoint(state_dict=weights | {"regressor.last.bias": torch.zeros(1).expand(7)})


def another(place: Place) -> None:
    place.put_checkpoint(state_dict={"regressor.last.bias": torch.zeros(7)})


def large(place: Place) -> None:
    size = {"depth": 50, "width": 64_000, "stride": 4, "channels": 64_000}
    place.put_config(backbone={"_target_": "phd_exp.models.locating.Locating"} | size)


def foreign(place: Place) -> None:
    place.put_config(backbone={"_target_": "os.system", "command": "touch owned"})


def imported(place: Place) -> None:
    place.put_config(backbone={"_target_": "phd_exp.models.residual.partial"})


def left(place: Place) -> None:
    place.put_config(model={"name": "quantiles", "head": {"_target_": "phd_exp.models.heads.QuantileHead"}})


def small(place: Place) -> None:
    place.put_record(images.saved(images.noise(32, 32, 3)))


def linked(place: Place) -> None:
    place.run.checkpoints.rename(place.root / "elsewhere")
    place.run.checkpoints.symlink_to(place.root / "elsewhere")
    interrupted(place)


def forgotten(place: Place) -> None:
    place.run.metrics_file.unlink()
    interrupted(place)


RECORDS: list[tuple[Callable[[Place], None], tuple[str, ...], str]] = [
    (trap, ONE, "last.ckpt: not a whole checkpoint (holds more than tensors and plain values, "),
    (trap_resumed, LEARN, "last.ckpt: not a whole checkpoint (holds more than tensors and plain values, "),
    (diverge, ONE, "photos/test/0.png: the network returns numbers that are not finite"),
    (repeat, ONE, "last.ckpt: not a whole checkpoint of this network (last.bias: repeats numbers"),
    (another, ONE, "last.ckpt: not a "),
    (large, ONE, "last.ckpt: not a whole checkpoint of this network ("),
    (foreign, ONE, "backbone._target_: 'os.system' is not built from a stored configuration"),
    (imported, ONE, "is only imported there"),
    (left, ONE, "no attribute 'QuantileHead'); use the version of phd_exp that recorded the run"),
    (lambda place: place.put_record(file_name="../../../secret.png"), VERIFY, "line 1: not a valid record ("),
    (lambda place: place.put_record(z=-1.0), VERIFY, "z: got -1.0; expected "),
    (small, VERIFY, "000000.png: cannot be read as an image ((32, 32) pixels of RGB; expected 64 x 64 of RGB)"),
    (linked, LEARN, "/checkpoints: is a link; "),
    (forgotten, LEARN, "metrics.jsonl: not the record of the epochs before last.ckpt; "),
]
"""What happened to a record, the command that reads it, and a part of the line that this causes."""
Entry = tuple[str | ZipInfo, bytes]


def packed(place: Place) -> list[Entry]:
    """The files of the place's run, as an archive of `pack` has them."""
    files = sorted(path for path in place.run.path.rglob("*") if path.is_file())
    found = [(path.relative_to(place.run.path).as_posix(), path.read_bytes()) for path in files]
    return [(name, content) for name, content in found if NAMES.fullmatch(name)]


def zipped(entries: list[Entry], compression: int = ZIP_STORED) -> bytes:
    stream = io.BytesIO()
    with ZipFile(stream, "w", compression) as archive:
        for entry, content in entries:
            archive.writestr(entry, content)
    return stream.getvalue()


def link(target: bytes) -> Entry:
    entry = ZipInfo("held_out.parquet")
    entry.create_system, entry.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
    return entry, target


def overlapping(entries: list[Entry]) -> bytes:
    """Five hundred files whose bytes are those of the first."""
    content = zipped([("metrics.jsonl", b" " * 100_000)])
    start = content.index(b"PK\x01\x02")
    one = bytearray(content[start : content.index(b"PK\x05\x06")])
    names = [f"labelled/{number:05}.parquet".encode() for number in range(500)]
    listed = b"".join(bytes(one[:28]) + struct.pack("<H", len(name)) + bytes(one[30:46]) + name for name in names)
    end = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, len(names), len(names), len(listed), start, 0)
    return content[:start] + listed + end


def damaged(entries: list[Entry]) -> bytes:
    content = bytearray(zipped(entries))
    content[content.index(b"mu_z0")] ^= 1
    return bytes(content)


def encrypted(entries: list[Entry]) -> bytes:
    content = bytearray(zipped(entries))
    content[content.rindex(b"PK\x01\x02") + 8] |= 1
    return bytes(content)


ARCHIVES: dict[str, tuple[Callable[[list[Entry]], bytes], str]] = {
    "no archive": (lambda entries: b"no archive at all" * 10, "its end is no end of a plain zip archive"),
    "damaged": (damaged, "Bad CRC-32 for file "),
    "a path up": (lambda entries: zipped([*entries, ("../owned", b"")]), "'../owned' is not a file of a packed run"),
    "an absolute path": (lambda entries: zipped([*entries, ("/tmp/owned", b"")]), "is not a file of a packed run"),
    "a link": (lambda entries: zipped([*entries, link(b"/etc/passwd")]), "held_out.parquet is a link"),
    "compressed": (lambda entries: zipped(entries, ZIP_DEFLATED), "is compressed or encrypted"),
    "encrypted": (encrypted, "is compressed or encrypted"),
    "overlapping": (overlapping, "its files together are larger than the archive"),
    "many": (lambda entries: zipped([(f"labelled/{n}.parquet", b"") for n in range(1001)]), "expected at most 1000"),
}
"""Archives of runs that `pack` does not write: how to make one of a run's files, and why it is refused."""

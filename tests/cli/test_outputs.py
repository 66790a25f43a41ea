"""Outputs of all verbs: what lies in their place is never harmed unless the same verb wrote it, and links stay."""

import json
import os
import re
import shutil
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from phd_exp.records.runs import RunFolder
from phd_exp.records.videos import VideoWriter
from phd_exp.records.written import Written
from tests.support.disks import KIB, leave_room, make_room, small_disk
from tests.support.untrained import NOWHERE, SMALL, untrained, write_metadata

POSE = {"rotation": [1, 0, 0, 0], "translation": [0, 0, 0]}
PHOTO = ("image=photos/0.png", "f=90", "box=8,12,32,38")
WRITERS = {
    "predict out=X.mcap": ("predict", "run=run", *PHOTO),
    "predict view=X.rrd": ("predict", "run=run", *PHOTO),
    "track out=X.mcap": ("track", "run=run", "folder=photos"),
    "track view=X.rrd": ("track", "run=run", "folder=photos"),
    "fuse out=X.jsonl": ("fuse", "run=run", "folder=photos"),
    "fuse out=X.mcap": ("fuse", "run=run", "folder=photos"),
    "fuse view=X.rrd": ("fuse", "run=run", "folder=photos"),
    "pack out=X.zip": ("pack", "run=run"),
    "export out=X.onnx": ("export", "run=run"),
    "calibrate name=X": ("calibrate", "run=run", "folder=photos"),
}
"""Verb and the file that it writes -> the words before it."""
IN_FOLDERS = {
    "predict": (("predict", "run=run", "folder=photos"), ["predictions.jsonl", "1-0.png", "2-1.png", "3-2.png"]),
    "track": (("track", "run=run", "folder=photos"), ["track.jsonl", "track.mp4"]),
}
"""Verb that writes into a folder -> its words, and the names of the files."""


@pytest.fixture(scope="module")
def place(composed: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run, and photographs that are a track and scenes too."""
    place = tmp_path_factory.mktemp("place")
    untrained(place / "run", composed(*SMALL, *NOWHERE)).write_results({"test/nll": -1.5})
    (place / "photos").mkdir()
    lines, draw = [], np.random.default_rng(0)
    for k in range(3):
        Image.fromarray(draw.integers(0, 256, (48, 64, 3), np.uint8)).save(place / f"photos/{k}.png")
        lines.append({"scene": k, "pose": POSE, "time": k / 20, "file_name": f"{k}.png", "f": 90.0, "z": 3.0})
    write_metadata(place / "photos", [line | {"x": 0, "y": 0} for line in lines])
    return place


@pytest.fixture
def here(place: Path, tmp_path: Path) -> Path:
    shutil.copytree(place, tmp_path, dirs_exist_ok=True)
    return tmp_path


def words_of(writer: str, name: str = "x") -> tuple[tuple[str, ...], Path]:
    """The words of a writer, and the file that it writes in the working directory."""
    if writer.startswith("calibrate"):
        return (*WRITERS[writer], f"name={name}"), Path(f"run/labelled/{name}.parquet")
    key, file = writer.split()[1].split("=")
    file = file.replace("X", name)
    return (*WRITERS[writer], f"{key}={file}"), Path(file)


def device(path: Path) -> None:
    try:
        os.mknod(path, 0o600 | stat.S_IFCHR, os.makedev(1, 3))  # a character device, as /dev/null
    except PermissionError:
        pytest.skip("making a device takes root")


OBSTACLES: dict[str, Callable[[Path], Any]] = {
    "a pipe": os.mkfifo,
    "a device": device,
    "a socket": lambda path: os.mknod(path, 0o600 | stat.S_IFSOCK),
    "a folder": lambda path: path.mkdir(),
    "a link to itself": lambda path: path.symlink_to(path.name),
    "a link to a pipe": lambda path: (os.mkfifo(path.with_name("far")), path.symlink_to("far")),
    "text": lambda path: path.write_text("my own"),
    "an image": lambda path: path.write_bytes(Path("photos/0.png").read_bytes()),
    "a link to text": lambda path: (path.with_name("far").write_text("my own"), path.symlink_to("far")),
}


def snapshot(folder: Path) -> dict[str, Any]:
    """Everything below a folder: kinds, contents, places of links."""
    found: dict[str, Any] = {}
    for path in sorted(folder.rglob("*")):
        kind = path.lstat().st_mode
        content = os.readlink(path) if path.is_symlink() else path.read_bytes() if path.is_file() else None
        found[str(path.relative_to(folder))] = kind, content
    return found


@pytest.fixture
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing may be computed."""
    for name in ("phd_exp.inference.loading.load", "phd_exp.inference.packing.pack"):
        monkeypatch.setattr(name, lambda *_, **__: pytest.fail("computed before the output was judged"))


@pytest.mark.parametrize("obstacle", OBSTACLES)
@pytest.mark.parametrize("writer", [*WRITERS, *IN_FOLDERS])
def test_what_is_in_the_place_of_an_output_is_refused_first(
    phd_exp: Callable, here: Path, no_network: None, writer: str, obstacle: str
) -> None:
    if writer in IN_FOLDERS:
        words, files = (*IN_FOLDERS[writer][0], "out=out"), [Path("out", name) for name in IN_FOLDERS[writer][1]]
    else:
        words, *files = words_of(writer)
    for file in files:
        file.parent.mkdir(exist_ok=True)
        OBSTACLES[obstacle](file)
        before = snapshot(here)
        outcome = phd_exp(*words)
        assert outcome.status == 2, outcome
        assert str(file) in outcome.error
        assert snapshot(here) == before
        shutil.rmtree(file) if file.is_dir() and not file.is_symlink() else file.unlink()
        file.with_name("far").unlink(missing_ok=True)


@pytest.mark.parametrize(
    "writer", [writer for writer in WRITERS if not writer.startswith(("pack", "export", "calibrate"))]
)
def test_a_link_stays_and_the_file_behind_it_is_written(phd_exp: Callable, here: Path, writer: str) -> None:
    """Also again, where the file is there."""
    words, file = words_of(writer)
    (here / "far").mkdir()
    file.symlink_to(f"far/{file}")
    for _ in range(2):
        outcome = phd_exp(*words)
        assert outcome.status == 0, outcome.err
        assert os.readlink(file) == f"far/{file}"
        assert (here / "far" / file).stat().st_size > 0
        (here / "far" / file).write_bytes((here / "far" / file).read_bytes()[:100])  # of an interrupted command
    assert os.listdir("far") == [str(file)]


@pytest.mark.parametrize("verb", IN_FOLDERS)
def test_a_folder_keeps_the_files_of_others_and_loses_what_is_no_longer_written(
    phd_exp: Callable, here: Path, verb: str
) -> None:
    words, names = IN_FOLDERS[verb]
    out = here / "out"
    out.mkdir()
    (out / names[0]).symlink_to(here / "elsewhere")
    mine = {"7.mp4": b"mine", "9-a.png": b"mine", f".notes.{'0' * 32}.tmp": b"mine"}
    for name, content in mine.items():
        (out / name).write_bytes(content)
    assert phd_exp(*words, "out=out").status == 0
    assert {path.name for path in out.iterdir()} == {*mine, *names, f".{Path(names[0]).stem}.written"}
    first = {name: (out / name).read_bytes() for name in names}
    again = phd_exp(*words, "out=out")
    assert again.err.startswith(f"out: of an earlier command, {len(names)} files replaced, 0 removed\n")
    assert {name: (out / name).read_bytes() for name in names} == first
    assert (out / names[0]).is_symlink()

    lines = (here / "photos/metadata.jsonl").read_text().splitlines()
    both = lines[:2] if verb == "predict" else [*lines, *(line.replace("{", '{"track": 1, ', 1) for line in lines)]
    (here / "photos/metadata.jsonl").write_text("\n".join(both))
    fewer = phd_exp(*words, "out=out")  # or two videos instead of one
    assert fewer.status == 0, fewer.err
    assert "1 removed" in fewer.err
    assert not (out / names[-1]).exists()
    assert all((out / name).read_bytes() == content for name, content in mine.items())

    (here / "photos/metadata.jsonl").write_text("\n".join(lines))
    changed = next(path for path in out.iterdir() if path.suffix in (".png", ".mp4") and path.name not in mine)
    changed.write_bytes(b"mine now")
    phd_exp(*words, "out=out")
    assert changed.read_bytes() == b"mine now"


INPUTS = [
    *(("pack", "run=run", f"out=run/{name}") for name in ("checkpoints/last.ckpt", "config.yaml", "more/run.zip")),
    *(("export", "run=run", f"out=run/{name}") for name in ("checkpoints/last.ckpt", "config.yaml", "run.zip")),
    ("export", "run=run.zip", "out=run.zip"),
    ("predict", "run=run", "folder=photos", "out=run"),
    ("predict", "run=run", "folder=photos", "out=run/pictures"),
    ("predict", "run=run", "folder=photos", "view=run/a.rrd"),
    ("fuse", "run=run", "folder=photos", "out=photos/metadata.jsonl"),
    ("fuse", "run=run", "folder=photos", "out=photos/0.png"),
    ("predict", "run=run", "image=photos/0.png", "camera=camera.yaml", "out=photos"),
    ("fuse", "run=run", "folder=described", "out=described/camera.yaml"),
    ("track", "run=run", "video=clips/track.mp4", "f=90", "out=clips"),
    ("track", "run=run", "video=clips/track.mp4", "f=90", "boxes=track.jsonl", "out=."),
    ("predict", "run=run", "image=photos/0.png", "f=90", "boxes=drawn/predictions.jsonl", "out=drawn"),
]


@pytest.mark.parametrize("words", INPUTS, ids=" ".join)
def test_no_output_is_an_input_or_in_the_folder_of_the_run(
    phd_exp: Callable, here: Path, no_network: None, words: tuple[str, ...]
) -> None:
    pytest.importorskip("av")
    for folder in ("clips", "described"):
        (here / folder).mkdir()
    with VideoWriter(here / "clips/track.mp4", (64, 48)) as video:
        video.add(0.0, np.zeros((48, 64, 3), np.uint8))
    camera = {"image_width": 64, "image_height": 48, "fx": 90, "fy": 90, "cx": 32, "cy": 24}
    for file in (here / "camera.yaml", here / "described/camera.yaml"):
        file.write_text(json.dumps(camera))
    shutil.copy(here / "photos/0.png", here / "described/0.png")
    write_metadata(here / "described", [{"scene": 0, "pose": POSE, "file_name": "0.png", "camera": "camera.yaml"}])
    (here / "track.jsonl").write_text(json.dumps([{"image_id": 0, "category_id": 1, "bbox": [8, 12, 24, 26]}]))
    boxes = [{"category_id": 1, "bbox": [8, 12, 24, 26]}]
    with Written(here / "drawn", "predictions") as written:
        written.write("predictions.jsonl", json.dumps(boxes))
    (here / "run.zip").write_bytes(b"PK\3\4" + bytes(26) + b"README.md")
    before = snapshot(here)
    outcome = phd_exp(*words)
    assert outcome.status == 2, outcome
    assert "\n" not in outcome.error
    assert snapshot(here) == before


def test_a_home_folder_is_found_in_every_value(
    phd_exp: Callable, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(here))
    outcome = phd_exp("predict", "run=~/run", "image=~/photos/0.png,~/photos/1.png", "f=90", "out=~/out")
    assert outcome.status == 0, outcome.err
    outcome = phd_exp("preset=smoke", "data.root=~/renders", "runs=~/runs", "--cfg", "job")
    assert f"root: {here}/renders" in outcome.out
    assert not (here / "~").exists()


@pytest.mark.parametrize("words", ["predict out=D", "predict view=D/a.rrd", "track out=D", "track view=D/a.rrd"])
def test_a_full_disk_is_one_line_and_the_same_command_runs_later(phd_exp: Callable, here: Path, words: str) -> None:
    verb, word = words.replace("D", "disk").split()
    with small_disk(here / "disk", 1024) as disk:
        for room in (0, 4 * KIB, 12 * KIB):
            leave_room(disk, room)
            outcome = phd_exp(verb, "run=run", "folder=photos", word)
            line = outcome.err.splitlines()[-1]  # Rerun has complained before
            assert re.match(r"error: disk.*: cannot be written \(No space left on device\); make room", line), outcome
            assert "Traceback" not in outcome.err
        make_room(disk)
        outcome = phd_exp(verb, "run=run", "folder=photos", word)
        assert outcome.status == 0, outcome.err


def test_a_run_of_links_is_not_written_through(phd_exp: Callable, here: Path) -> None:
    (here / "mine.parquet").write_bytes(b"PAR1 mine")
    (here / "run/labelled").mkdir()
    (here / "run/labelled/photographs.parquet").symlink_to(here / "mine.parquet")
    assert "is a link" in phd_exp("calibrate", "run=run", "folder=photos").error
    assert RunFolder(here / "run").labelled("photographs").read_bytes() == b"PAR1 mine"

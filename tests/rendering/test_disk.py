"""A disk that is full, turns read-only or goes away costs one line and nothing else: the same call goes on."""

import os
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from PIL import Image

from phd_exp.records.dataset import SPLITS, DatasetFolder
from phd_exp.records.errors import RenderError
from phd_exp.records.files import read_jsonl
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.render import ensure_rendered
from tests.disks import KIB, leave_room, make_room, remount, small_disk
from tests.rendering.folders import contents, wait_until

N_TRAIN, N_TEST = 12, 4


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with small_disk(tmp_path / "disk", 1024) as place:
        yield place


def finished(folder: DatasetFolder) -> dict[Path, int]:
    """The images that have their line in a journal, each of them whole, and when it was written."""
    paths = [
        folder.split_folder(split) / line["file_name"]
        for split in SPLITS
        if folder.journal_path(split).exists()
        for line in read_jsonl(folder.journal_path(split))
    ]
    for path in paths:
        with Image.open(path) as image:
            image.load()
    return {path: path.stat().st_mtime_ns for path in paths}


def journaled(folder: DatasetFolder) -> int:
    path = folder.journal_path("train")
    return path.read_bytes().count(b"\n") if path.exists() else 0


def refused(folder: DatasetFolder, spec: DatasetSpec, reason: str) -> dict[Path, int]:
    """Let a render fail in one line for a reason; what is finished then."""
    with pytest.raises(RenderError, match=rf"cannot be written \({reason}\); make room, allow") as error:
        ensure_rendered(folder, spec, N_TRAIN, N_TEST, workers=1)
    assert "\n" not in str(error.value)
    return finished(folder)


def unseal(folder: DatasetFolder) -> None:
    """As a kill just before the end leaves it: every image and every line in the journals."""
    for split in SPLITS:
        folder.metadata_path(split).rename(folder.journal_path(split))
    folder.write_manifest(folder.manifest.model_copy(update={"splits": {}}))


def test_a_full_disk_is_one_line_and_nothing_is_lost(
    disk: Path, small: DatasetFolder, small_spec: DatasetSpec
) -> None:
    """Full before the first byte, among the images, and when the journals become `metadata.jsonl`."""
    folder = DatasetFolder(disk / "default")
    leave_room(disk, 0)
    assert refused(folder, small_spec, "No space left on device") == {}
    leave_room(disk, 28 * KIB)
    some = refused(folder, small_spec, "No space left on device")
    assert 0 < len(some) < N_TRAIN + N_TEST
    make_room(disk)
    ensure_rendered(folder, small_spec, N_TRAIN, N_TEST, workers=1)
    assert contents(folder) == contents(small)
    assert all(path.stat().st_mtime_ns == moment for path, moment in some.items())

    unseal(folder)
    leave_room(disk, 8 * KIB)
    assert len(refused(folder, small_spec, "No space left on device")) == N_TRAIN + N_TEST
    make_room(disk)
    ensure_rendered(folder, small_spec, N_TRAIN, N_TEST)
    assert contents(folder) == contents(small)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="the system has no file that is always full")
def test_a_journal_without_room_is_one_line(
    tmp_path: Path, small: DatasetFolder, small_spec: DatasetSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = DatasetFolder(tmp_path / "default")
    with monkeypatch.context() as patch:
        patch.setattr(
            "phd_exp.rendering.render.open_journal",
            lambda _: os.fdopen(os.open("/dev/full", os.O_WRONLY), "w", buffering=1),
        )
        assert refused(folder, small_spec, "No space left on device") == {}
    assert 0 < len(folder.images("train")) < N_TRAIN, "no further image is begun"
    ensure_rendered(folder, small_spec, N_TRAIN, N_TEST, workers=1)
    assert contents(folder) == contents(small)


def test_a_disk_that_turns_read_only_serves_what_it_has(
    disk: Path, small: DatasetFolder, small_spec: DatasetSpec
) -> None:
    folder = DatasetFolder(disk / "default")
    ensure_rendered(folder, small_spec, 3, 1, workers=1)
    before = contents(folder)
    remount(disk, "ro")
    refused(folder, small_spec, "Read-only file system")
    ensure_rendered(folder, small_spec, 3, 1)
    assert folder.records("train") == small.records("train", 3)
    assert contents(folder) == before
    remount(disk, "rw")
    ensure_rendered(folder, small_spec, N_TRAIN, N_TEST, workers=1)
    assert contents(folder) == contents(small)


def test_a_folder_that_goes_away_amid_a_render_is_one_line(
    tmp_path: Path, small: DatasetFolder, small_spec: DatasetSpec
) -> None:
    """A file in its place: refused even to root, who may write wherever there is a folder."""
    folder = DatasetFolder(tmp_path / "default")
    train, away = folder.split_folder("train"), tmp_path / "away"

    def take_away() -> None:
        wait_until(lambda: journaled(folder) >= 2)
        train.rename(away)
        train.touch()

    thief = threading.Thread(target=take_away)
    thief.start()
    with pytest.raises(
        RenderError, match=r"cannot be written \(Not a directory\); make room, allow"
    ) as error:
        ensure_rendered(folder, small_spec, N_TRAIN, N_TEST, workers=1)
    thief.join()
    assert "\n" not in str(error.value)
    train.unlink()
    away.rename(train)
    safe = finished(folder)
    assert len(safe) >= 2
    ensure_rendered(folder, small_spec, N_TRAIN, N_TEST, workers=1)
    assert contents(folder) == contents(small)
    assert all(path.stat().st_mtime_ns == moment for path, moment in safe.items())

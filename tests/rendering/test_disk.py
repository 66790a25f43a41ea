"""A disk that is full, turns read-only or disappears causes one line of error; the same call then resumes."""

import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.errors import RenderError
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.render import ensure_rendered
from tests.support.disks import KIB, leave_room, make_room, remount, small_disk
from tests.support.renders import N_TEST, N_TRAIN, contents, journaled, unsealed, wait_until


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with small_disk(tmp_path / "disk", 1024) as place:
        yield place


def refused(folder: DatasetFolder, spec: DatasetSpec, reason: str) -> dict[Path, int]:
    """A render that fails in one line for a reason; returns the images that are finished then."""
    with pytest.raises(RenderError, match=rf"cannot be written \({reason}\); make room, allow") as error:
        ensure_rendered(folder, spec, N_TRAIN, N_TEST, workers=1)
    assert "\n" not in str(error.value)
    return journaled(folder)


def test_a_full_disk_is_one_line_and_nothing_is_lost(
    disk: Path, small_spec: DatasetSpec, complete: Callable[..., None]
) -> None:
    """Full before the first byte, among the images, and when the journals become `metadata.jsonl`."""
    folder = DatasetFolder(disk / "default")
    leave_room(disk, 0)
    assert refused(folder, small_spec, "No space left on device") == {}
    leave_room(disk, 28 * KIB)
    some = refused(folder, small_spec, "No space left on device")
    assert 0 < len(some) < N_TRAIN + N_TEST
    make_room(disk)
    complete(folder, some)

    unsealed(folder)
    leave_room(disk, 8 * KIB)
    every = refused(folder, small_spec, "No space left on device")
    assert len(every) == N_TRAIN + N_TEST
    make_room(disk)
    complete(folder, every)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="the system has no file that is always full")
def test_a_journal_without_room_is_one_line(
    folder: DatasetFolder, small_spec: DatasetSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: Path) -> object:
        return os.fdopen(os.open("/dev/full", os.O_WRONLY), "w", buffering=1)

    monkeypatch.setattr("phd_exp.rendering.render.open_journal", full)
    assert refused(folder, small_spec, "No space left on device") == {}
    assert 0 < len(folder.images("train")) < N_TRAIN, "no further image is begun"


def test_a_disk_that_turns_read_only_serves_its_images(
    disk: Path, small: DatasetFolder, small_spec: DatasetSpec, copied: None
) -> None:
    folder = DatasetFolder(disk / "default")
    ensure_rendered(folder, small_spec, 3, 1)
    before = contents(folder)
    remount(disk, "ro")
    refused(folder, small_spec, "Read-only file system")
    assert ensure_rendered(folder, small_spec, 3, 1)
    assert folder.records("train") == small.records("train", 3)
    assert contents(folder) == before


def test_a_folder_that_disappears_amid_a_render_is_one_line(
    folder: DatasetFolder, small_spec: DatasetSpec, complete: Callable[..., None], tmp_path: Path
) -> None:
    """A file in its place is refused even to root, who may write wherever there is a folder."""
    train, away = folder.split_folder("train"), tmp_path / "away"

    def take_away() -> None:
        wait_until(lambda: len(journaled(folder)) >= 2)
        train.rename(away)
        train.touch()

    thief = threading.Thread(target=take_away)
    thief.start()
    refused(folder, small_spec, "Not a directory")
    thief.join()
    train.unlink()
    away.rename(train)
    safe = journaled(folder)
    assert len(safe) >= 2
    complete(folder, safe)

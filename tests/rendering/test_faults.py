"""A render that is killed, or whose disk fails, loses only images in progress, and resumes to the same bytes."""

import os
import random
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.errors import RenderError
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.render import ensure_rendered
from tests.support.disks import KIB, leave_room, make_room, remount, small_disk
from tests.support.renders import (
    N_TEST,
    N_TRAIN,
    contents,
    decoded,
    made,
    rendering_elsewhere,
    unsealed,
    wait_until,
    written,
)

pytestmark = pytest.mark.skipif(not Path("/proc/self").exists(), reason="finds processes through /proc")


def render_workers(parent: int) -> list[int]:
    """Process ids of the living workers of a process."""
    found = []
    for status in Path("/proc").glob("[0-9]*/status"):
        try:
            fields = dict(line.split(":", 1) for line in status.read_text().splitlines())
            command = (status.parent / "cmdline").read_bytes()
        except (FileNotFoundError, ProcessLookupError):
            continue
        if int(fields["PPid"]) == parent and b"spawn_main" in command:
            found.append(int(status.parent.name))
    return found


def alive(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != "Z"


@pytest.mark.parametrize("stop", [signal.SIGKILL, signal.SIGINT], ids=["kill", "interrupt"])
def test_a_stopped_parent_leaves_no_workers_and_its_images_are_kept(
    folder: DatasetFolder, small_spec: DatasetSpec, complete: Callable[..., None], stop: signal.Signals
) -> None:
    with rendering_elsewhere(folder, small_spec) as process:
        wait_until(lambda: render_workers(process.pid))
        # before there are images, because this search takes as long as rendering some of them
        workers = render_workers(process.pid)
        wait_until(lambda: len(made(folder)) >= 2)
        process.send_signal(stop)
        process.communicate()
        if stop == signal.SIGINT:
            assert not any(alive(worker) for worker in workers)
        wait_until(lambda: not any(alive(worker) for worker in workers))
    done = made(folder)
    assert 2 <= len(done) < N_TRAIN + N_TEST
    assert len(written(folder)) <= len(done) + 1
    complete(folder, done)


def test_a_killed_worker_is_one_line_and_its_work_is_kept(
    folder: DatasetFolder, small_spec: DatasetSpec, complete: Callable[..., None]
) -> None:
    def kill_one() -> None:
        wait_until(lambda: made(folder))
        os.kill(render_workers(os.getpid())[0], signal.SIGKILL)

    killer = threading.Thread(target=kill_one)
    killer.start()
    with pytest.raises(RenderError, match=r"a render worker was killed, or memory ran out; finished images are kept"):
        ensure_rendered(folder, small_spec, N_TRAIN, N_TEST, workers=2)
    killer.join()
    assert not render_workers(os.getpid())
    done = made(folder)
    assert done
    complete(folder, done)


def kill_amid_work(process: subprocess.Popen[str], folder: DatasetFolder, moments: random.Random) -> None:
    """After a few more images and a moment, kill the parent alone, whose workers finish theirs, or the group."""
    enough = len(made(folder)) + moments.randint(1, 2)
    wait_until(lambda: len(made(folder)) >= enough)
    time.sleep(moments.uniform(0.0, 0.02))
    workers = render_workers(process.pid)
    if moments.random() < 0.5:
        process.kill()
    else:
        os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    wait_until(lambda: not any(alive(worker) for worker in workers))


@pytest.mark.slow
def test_twenty_kills_at_random_moments_of_one_render(
    folder: DatasetFolder, small_spec: DatasetSpec, tmp_path: Path
) -> None:
    """Every image on disk is whole, no finished one is touched again, and few are rendered twice."""
    moments, kills, workers, n_train, n_test = random.Random(0), 20, 2, 60, 20
    safe: dict[Path, int] = {}
    seen: set[tuple[Path, int]] = set()  # an image that is rendered twice is here twice
    for _ in range(kills):
        with rendering_elsewhere(folder, small_spec, workers, (n_train, n_test)) as process:
            kill_amid_work(process, folder, moments)
        now = written(folder)
        for path in now:
            decoded(path.read_bytes())
        assert safe.items() <= now.items()
        safe = made(folder)
        seen |= now.items()
    assert len(safe) < n_train + n_test, "every kill met a render under way"
    ensure_rendered(folder, small_spec, n_train, n_test, workers)
    now = written(folder)
    assert safe.items() <= now.items()
    assert n_train + n_test <= len(seen | now.items()) <= n_train + n_test + kills * workers
    whole = DatasetFolder(tmp_path / "whole")
    ensure_rendered(whole, small_spec, n_train, n_test, workers)
    assert contents(folder) == contents(whole)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with small_disk(tmp_path / "disk", 1024) as place:
        yield place


def refused(folder: DatasetFolder, spec: DatasetSpec, reason: str) -> dict[Path, int]:
    """A render that fails in one line for a reason; returns the images that are finished then."""
    with pytest.raises(RenderError, match=rf"cannot be written \({reason}\); make room, allow") as error:
        ensure_rendered(folder, spec, N_TRAIN, N_TEST, workers=1)
    assert "\n" not in str(error.value)
    return made(folder)


def test_a_full_disk_is_one_line_and_nothing_is_lost(
    disk: Path, small_spec: DatasetSpec, complete: Callable[..., None]
) -> None:
    """Full before the first byte, among the images, and when the side files become `metadata.jsonl`."""
    folder = DatasetFolder(disk / "default")
    leave_room(disk, 0)
    assert refused(folder, small_spec, "No space left on device") == {}
    leave_room(disk, 60 * KIB)
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

"""Killed at any moment, a render loses at most the samples in flight, and ends with the same bytes."""

import json
import os
import random
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from PIL import Image

from phd_exp.records.dataset import SPLITS, DatasetFolder
from phd_exp.records.errors import DatasetError, RenderError
from phd_exp.records.scenes import Split
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.render import ensure_rendered
from tests.rendering.folders import PATIENCE, contents, in_a_process, wait_until

pytestmark = pytest.mark.skipif(not Path("/proc/self").exists(), reason="finds processes through /proc")

N_TRAIN, N_TEST = 12, 4


@pytest.fixture
def folder(tmp_path: Path) -> DatasetFolder:
    return DatasetFolder(tmp_path / "default")


def journaled(folder: DatasetFolder) -> int:
    return sum(len(finished(folder, split)) for split in SPLITS)


def finished(folder: DatasetFolder, split: Split) -> list[Path]:
    """The images that have their line in the journal."""
    path = folder.journal_path(split)
    lines = path.read_text().split("\n")[:-1] if path.exists() else []
    return [folder.split_folder(split) / json.loads(line)["file_name"] for line in lines]


def written(folder: DatasetFolder) -> dict[Path, int]:
    """When each image on disk was written, ns."""
    return {path: path.stat().st_mtime_ns for path in folder.root.rglob("*.png")}


def render_workers(parent: int) -> list[int]:
    """Process ids of the living workers of a process."""
    found = []
    for status in Path("/proc").glob("[0-9]*/status"):
        try:
            fields = dict(line.split(":", 1) for line in status.read_text().splitlines())
            command = (status.parent / "cmdline").read_bytes()
        except (FileNotFoundError, ProcessLookupError):
            continue
        if int(fields["PPid"]) == parent and b"phd_exp.rendering.worker" in command:
            found.append(int(status.parent.name))
    return found


def alive(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != "Z"


@contextmanager
def rendering_elsewhere(
    folder: DatasetFolder, spec: DatasetSpec, n_train: int = N_TRAIN, n_test: int = N_TEST
) -> Iterator[subprocess.Popen[bytes]]:
    """The same work in a process, and a group of processes, of its own, to be killed."""
    call = f"ensure_rendered(folder, spec, {n_train}, {n_test}, workers=2)"
    with in_a_process(call, folder, spec, stderr=subprocess.DEVNULL, start_new_session=True) as process:
        yield process


def test_a_killed_parent_leaves_no_workers_and_no_half_files(
    folder: DatasetFolder, small: DatasetFolder, small_spec: DatasetSpec
) -> None:
    with rendering_elsewhere(folder, small_spec) as process:
        wait_until(lambda: len(render_workers(process.pid)) == 2)
        orphans = render_workers(
            process.pid
        )  # before there are images: to look takes as long as some of them
        wait_until(lambda: journaled(folder) >= 2)
        process.kill()
        process.wait()
        done = journaled(folder)
        wait_until(lambda: not any(alive(orphan) for orphan in orphans))
    assert done < N_TRAIN
    before = {path.name: path.stat().st_mtime_ns for path in folder.split_folder("train").glob("*.png")}
    assert len(before) <= done + 2
    ensure_rendered(folder, small_spec, N_TRAIN, N_TEST, workers=2)
    assert contents(folder) == contents(small)
    kept = sum(
        folder.image_path("train", int(name[:6])).stat().st_mtime_ns == t for name, t in before.items()
    )
    assert kept >= done, "finished images are not rendered again"


def test_an_interrupt_ends_all_processes_after_the_samples_in_flight(
    folder: DatasetFolder, small: DatasetFolder, small_spec: DatasetSpec
) -> None:
    with rendering_elsewhere(folder, small_spec) as process:
        wait_until(lambda: len(render_workers(process.pid)) == 2)
        workers = render_workers(
            process.pid
        )  # before there are images: to look takes as long as some of them
        wait_until(lambda: journaled(folder) >= 2)
        process.send_signal(signal.SIGINT)
        process.wait(timeout=PATIENCE)
        assert not any(alive(worker) for worker in workers)
    assert len(list(folder.split_folder("train").glob("*.png"))) <= journaled(folder) + 2
    ensure_rendered(folder, small_spec, N_TRAIN, N_TEST, workers=2)
    assert contents(folder) == contents(small)


def test_a_killed_worker_is_one_line_and_its_work_is_kept(
    folder: DatasetFolder, small: DatasetFolder, small_spec: DatasetSpec
) -> None:
    def kill_one() -> None:
        wait_until(lambda: journaled(folder) >= 1)
        os.kill(render_workers(os.getpid())[0], signal.SIGKILL)

    killer = threading.Thread(target=kill_one)
    killer.start()
    with pytest.raises(
        RenderError, match=r"a render worker .* was killed by SIGKILL; finished images are kept"
    ):
        ensure_rendered(folder, small_spec, N_TRAIN, N_TEST, workers=2)
    killer.join()
    assert not render_workers(os.getpid())
    assert journaled(folder) >= 1
    ensure_rendered(folder, small_spec, N_TRAIN, N_TEST, workers=2)
    assert contents(folder) == contents(small)


def test_two_at_once_share_the_work(
    folder: DatasetFolder, small: DatasetFolder, small_spec: DatasetSpec, capfd: pytest.CaptureFixture[str]
) -> None:
    with rendering_elsewhere(folder, small_spec) as process:
        wait_until(lambda: journaled(folder) >= 1)
        ensure_rendered(folder, small_spec, N_TRAIN, N_TEST)
        assert process.wait() == 0
    assert contents(folder) == contents(small)
    said = capfd.readouterr().err
    assert "another process is rendering here; waiting" in said
    assert "rendering the remaining" not in said


def test_a_kill_between_sealing_and_the_manifest(
    folder: DatasetFolder, small: DatasetFolder, small_spec: DatasetSpec
) -> None:
    ensure_rendered(folder, small_spec, N_TRAIN, N_TEST, workers=2)
    folder.write_manifest(folder.manifest.model_copy(update={"splits": {}}))
    ensure_rendered(folder, small_spec, N_TRAIN, N_TEST)
    assert contents(folder) == contents(small)


def test_a_torn_last_line_is_rendered_again_and_a_torn_line_elsewhere_is_named(
    folder: DatasetFolder, small: DatasetFolder, small_spec: DatasetSpec
) -> None:
    ensure_rendered(folder, small_spec, 3, 0, workers=1)
    folder.write_manifest(folder.manifest.model_copy(update={"splits": {}}))
    journal = folder.metadata_path("train").rename(folder.journal_path("train"))
    whole = journal.read_text()
    first, second, third = whole.splitlines(keepends=True)

    journal.write_text(first + second[:100] + "\n" + third)
    with pytest.raises(DatasetError, match=r"metadata\.partial\.jsonl, line 2: .*; remove that line"):
        ensure_rendered(folder, small_spec, N_TRAIN, N_TEST)
    assert journal.read_text() == first + second[:100] + "\n" + third

    journal.write_text(first + second + third[:100])
    ensure_rendered(folder, small_spec, N_TRAIN, N_TEST)
    assert contents(folder) == contents(small)


def kill_amid_work(process: subprocess.Popen[bytes], folder: DatasetFolder, moments: random.Random) -> None:
    """After a few more images and a moment: the parent alone, whose workers finish what they hold, or the group."""
    enough = journaled(folder) + moments.randint(1, 2)
    wait_until(lambda: journaled(folder) >= enough)
    time.sleep(moments.uniform(0.0, 0.02))
    workers = render_workers(process.pid)
    if moments.random() < 0.5:
        process.kill()
    else:
        os.killpg(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    wait_until(lambda: not any(alive(worker) for worker in workers))


@pytest.mark.slow
def test_twenty_kills_at_random_moments_of_one_render(
    folder: DatasetFolder, small_spec: DatasetSpec, tmp_path: Path
) -> None:
    """Every image on disk is whole, none that is finished is touched again, and hardly any is rendered twice."""
    moments, kills, workers, n_train, n_test = random.Random(0), 20, 2, 60, 20
    safe: dict[Path, int] = {}
    seen: set[tuple[Path, int]] = set()  # an image that is rendered twice is here twice
    for _ in range(kills):
        with rendering_elsewhere(folder, small_spec, n_train, n_test) as process:
            kill_amid_work(process, folder, moments)
        now = written(folder)
        for path in now:
            with Image.open(path) as image:
                image.load()
        assert safe.items() <= now.items()
        safe = {path: now[path] for split in SPLITS for path in finished(folder, split)}
        seen |= now.items()
    assert len(safe) < n_train + n_test, "every kill met a render under way"
    ensure_rendered(folder, small_spec, n_train, n_test, workers)
    now = written(folder)
    assert safe.items() <= now.items()
    assert n_train + n_test <= len(seen | now.items()) <= n_train + n_test + kills * workers
    whole = DatasetFolder(tmp_path / "whole")
    ensure_rendered(whole, small_spec, n_train, n_test, workers)
    assert contents(folder) == contents(whole)

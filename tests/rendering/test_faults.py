"""A render that is killed at any moment loses at most the samples in progress, and resumes to the same bytes."""

import os
import random
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.errors import DatasetError, RenderError
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.render import ensure_rendered
from tests.support.renders import (
    N_TEST,
    N_TRAIN,
    contents,
    decoded,
    journaled,
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
        if int(fields["PPid"]) == parent and b"phd_exp.rendering.worker" in command:
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
        wait_until(lambda: len(journaled(folder)) >= 2)
        process.send_signal(stop)
        process.communicate()
        done = journaled(folder)
        if stop == signal.SIGINT:
            assert not any(alive(worker) for worker in workers)
        wait_until(lambda: not any(alive(worker) for worker in workers))
    assert 2 <= len(done) < N_TRAIN + N_TEST
    assert len(written(folder)) <= len(done) + 1
    complete(folder, done)


def test_a_killed_worker_is_one_line_and_its_work_is_kept(
    folder: DatasetFolder, small_spec: DatasetSpec, complete: Callable[..., None]
) -> None:
    def kill_one() -> None:
        wait_until(lambda: journaled(folder))
        os.kill(render_workers(os.getpid())[0], signal.SIGKILL)

    killer = threading.Thread(target=kill_one)
    killer.start()
    with pytest.raises(RenderError, match=r"a render worker.* was killed by SIGKILL; finished images are kept"):
        ensure_rendered(folder, small_spec, N_TRAIN, N_TEST, workers=2)
    killer.join()
    assert not render_workers(os.getpid())
    done = journaled(folder)
    assert done
    complete(folder, done)


def test_a_torn_last_line_is_rendered_again_and_a_torn_line_elsewhere_is_named(
    folder: DatasetFolder, small_spec: DatasetSpec, copied: None, complete: Callable[..., None]
) -> None:
    ensure_rendered(folder, small_spec, 3, 0)
    unsealed(folder)
    journal = folder.journal_path("train")
    first, second, third = journal.read_text().splitlines(keepends=True)
    broken = first + second[:100] + "\n" + third
    journal.write_text(broken)
    with pytest.raises(DatasetError, match=r"metadata\.partial\.jsonl, line 2: .*; remove that line"):
        ensure_rendered(folder, small_spec, N_TRAIN, N_TEST)
    assert journal.read_text() == broken

    journal.write_text(first + second + third[:100])
    complete(folder, {})


def kill_amid_work(process: subprocess.Popen[str], folder: DatasetFolder, moments: random.Random) -> None:
    """After a few more images and a moment, kill the parent alone, whose workers finish theirs, or the group."""
    enough = len(journaled(folder)) + moments.randint(1, 2)
    wait_until(lambda: len(journaled(folder)) >= enough)
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
        safe = journaled(folder)
        seen |= now.items()
    assert len(safe) < n_train + n_test, "every kill met a render under way"
    ensure_rendered(folder, small_spec, n_train, n_test, workers)
    now = written(folder)
    assert safe.items() <= now.items()
    assert n_train + n_test <= len(seen | now.items()) <= n_train + n_test + kills * workers
    whole = DatasetFolder(tmp_path / "whole")
    ensure_rendered(whole, small_spec, n_train, n_test, workers)
    assert contents(folder) == contents(whole)

"""Locks exclude other processes; lines of messages; processes on one core."""

import os
import threading
from pathlib import Path

import pytest

from phd_exp.records.processes import announce, held, one_core


def test_a_lock_is_held_once_and_awaited_in_silence_if_it_is_free(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    lock = tmp_path / "lock"
    for _ in range(2):
        with held(lock, waiting="nobody waits") as first, held(lock) as second:
            assert [first, second] == [True, False]
    assert capfd.readouterr().err == ""


def test_a_lock_that_is_a_link_is_refused(tmp_path: Path) -> None:
    (tmp_path / "lock").symlink_to(tmp_path / "diary")
    with pytest.raises(OSError, match="symbolic links"), held(tmp_path / "lock"):
        pass
    assert not (tmp_path / "diary").exists()


def test_a_line_controls_no_terminal(capfd: pytest.CaptureFixture[str]) -> None:
    announce("a\x1b[2Jb\u202ec\x9bd\ne\u2066f\udcffg 中")
    assert capfd.readouterr().err == "a?[2Jb?c?d e?f?g 中\n"


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system binds no process to cores")
def test_one_core_is_for_the_body_alone_also_of_threads_that_it_starts() -> None:
    before = os.sched_getaffinity(0)
    seen: list[set[int]] = []
    begin, noted = threading.Event(), threading.Event()

    def note() -> None:
        seen.append(os.sched_getaffinity(0))
        noted.set()
        begin.wait()
        seen.append(os.sched_getaffinity(0))

    thread = threading.Thread(target=note)
    with one_core():
        assert len(os.sched_getaffinity(0)) == 1
        thread.start()
        assert noted.wait(10)
    begin.set()
    thread.join()
    assert len(seen[0]) == 1
    assert seen[1] == os.sched_getaffinity(0) == before

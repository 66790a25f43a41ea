"""What a machine refuses amid a training costs one line; later the same command ends as if nothing had happened."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from phd_exp.records.runs import RunFolder
from phd_exp.training.module import PositionModule
from tests.support.disks import KIB, leave_room, make_room, remount, small_disk
from tests.support.recorded import only_run, weights

QUIET = ("logger=none", "recipe=strong", "data.image_size=64", "backbone.width=8", "trainer.max_epochs=3")


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with small_disk(tmp_path / "disk", 16 * KIB) as place:
        yield place


@pytest.fixture(scope="module")
def unhindered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the run is kept that all others have to end as."""
    return tmp_path_factory.mktemp("unhindered")


@pytest.fixture
def ends_as_unhindered(train: Callable, unhindered: Path) -> Callable[[Path], None]:
    """The same command, once nothing hinders it any more, has to leave what a run in one piece leaves."""

    def check(runs: Path) -> None:
        assert train(*QUIET, f"runs={unhindered}").status == 0
        assert train(*QUIET, f"runs={runs}").status == 0
        mine, whole = only_run(runs), only_run(unhindered)
        assert mine.results_file.read_bytes() == whole.results_file.read_bytes()
        assert mine.metrics() == whole.metrics()
        for one, other in zip(weights(mine).values(), weights(whole).values(), strict=True):
            assert torch.equal(one, other)

    return check


def refused(outcome: Any) -> str:
    assert outcome.status == 1
    (line,) = [line for line in outcome.err.splitlines() if line.startswith("error: ")]
    assert "Traceback" not in outcome.err
    return str(line)


@pytest.mark.slow
def test_a_disk_that_fails_at_any_moment_is_one_line_and_nothing_is_lost(
    train: Callable, disk: Path, monkeypatch: pytest.MonkeyPatch, ends_as_unhindered: Callable
) -> None:
    """Full before the first byte, at the first and second checkpoint and the results; read-only in between."""
    runs, epoch_ends, write_results = disk / "runs", PositionModule.on_train_epoch_end, RunFolder.write_results

    def fill_after_an_epoch(self: PositionModule) -> None:
        epoch_ends(self)
        if self.current_epoch == 1:
            leave_room(disk, 0)

    def fill_before_the_results(self: RunFolder, results: Any) -> None:
        leave_room(disk, 0)
        write_results(self, results)

    for room in (0, 200 * KIB):
        leave_room(disk, room)
        assert "No space left on device" in refused(train(*QUIET, f"runs={runs}"))
    assert not list(runs.rglob("*.tmp"))
    assert not list(runs.rglob("last.ckpt"))
    make_room(disk)
    with monkeypatch.context() as patch:
        patch.setattr(PositionModule, "on_train_epoch_end", fill_after_an_epoch)
        line = refused(train(*QUIET, f"runs={runs}"))
    assert "No space left on device; mend that, and the same command resumes" in line
    assert torch.load(only_run(runs).last_checkpoint, weights_only=True)["epoch"] == 0
    make_room(disk)
    remount(disk, "ro")
    assert "is in the way or read-only" in refused(train(*QUIET, f"runs={runs}"))
    remount(disk, "rw")
    with monkeypatch.context() as patch:
        patch.setattr(RunFolder, "write_results", fill_before_the_results)
        assert "results.json: No space left on device" in refused(train(*QUIET, f"runs={runs}"))
    make_room(disk)
    assert not only_run(runs).is_finished()
    ends_as_unhindered(runs)

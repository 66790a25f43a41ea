"""Several processes that train one run: the numbers of one process, one record, and one end."""

import json
import multiprocessing
import os
import re
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from time import sleep

import pandas as pd
import pytest

from phd_exp.evaluation.volumes import LOG_VOLUMES
from phd_exp.records.runs import find_runs
from phd_exp.training import ranks as ranks_module
from tests.e2e.conftest import QUICK
from tests.support.recorded import only_run, status_of
from tests.support.renders import wait_until

THREE_EPOCHS = (
    "logger=none",
    "trainer.max_epochs=3",
    "evaluation.calibration_every_n_epochs=1",
    "data.n_test=7",
    "trainer.precision=float32",  # bfloat16 rounds the sums of the shares
)
TOGETHER = ("trainer=ddp", "trainer.accelerator=cpu")


def descendants(process: int) -> list[int]:
    """The processes of a training that a process started, in the order of their ranks."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = int(stat.read_text().rpartition(")")[2].split()[1])
            words = (stat.parent / "cmdline").read_text().split("\0")
        except (OSError, IndexError):
            continue
        if parent == process and "--multiprocessing-fork" in words:
            found.append(int(stat.parent.name))
    return sorted(found)


def alive(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.slow
def test_the_numbers_are_those_of_one_process(train: Callable, tmp_path: Path) -> None:
    assert train(*THREE_EPOCHS, "runs=alone").status == 0
    outcome = train(*THREE_EPOCHS, *TOGETHER, "trainer.threads=2", "runs=together")
    assert outcome.status == 0, outcome.err
    assert re.fullmatch(r"(.*another process decodes images; waiting for it\n)?", outcome.err)
    assert outcome.out.count("epoch 1/3") == 0
    alone, together = only_run(tmp_path / "alone"), only_run(tmp_path / "together")
    assert together.results()["devices"] == 2
    assert together.results()["threads"] == 1
    for one, other in zip(alone.metrics(), together.metrics(), strict=True):
        assert other == pytest.approx(one, rel=1e-4)
    for name in ("predictions.parquet", "held_out.parquet"):
        one, other = pd.read_parquet(alone.path / name), pd.read_parquet(together.path / name)
        assert list(other["file_name"]) == list(one["file_name"])
        drawn = ["energy_score", *LOG_VOLUMES.values()]  # at random, depending on which samples share a batch
        pd.testing.assert_frame_equal(one.drop(columns=drawn), other.drop(columns=drawn), rtol=1e-3, atol=1e-5)
    for curve in ("epoch-0000", "final"):
        curves = [json.loads(run.curves(curve).read_text()) for run in (alone, together)]
        assert curves[1]["depth"]["predicted"] == pytest.approx(curves[0]["depth"]["predicted"], rel=1e-3)
    assert {file.name for file in together.path.rglob("*")} == {file.name for file in alone.path.rglob("*")}


@pytest.fixture
def killing_a_rank() -> Iterator[Callable[[Path, int], list[int]]]:
    """Kill one of the processes once a run has trained for an epoch; the ids of all of them come back."""
    threads: list[threading.Thread] = []

    def arm(runs: Path, place: int) -> list[int]:
        found: list[int] = []

        def kill() -> None:
            wait_until(lambda: len(list(runs.rglob("last.ckpt"))) == 1)
            found.extend(descendants(os.getpid()))
            os.kill(found[place], signal.SIGKILL)

        threads.append(threading.Thread(target=kill))
        threads[-1].start()
        return found

    yield arm
    for thread in threads:
        thread.join()


@pytest.mark.slow
@pytest.mark.usefixtures("run")  # its data exists, so that no line is about rendering
@pytest.mark.parametrize(("place", "delay"), [(0, 0.0), (1, 0.0), (1, 3.0)])
def test_one_killed_ends_all_and_the_same_command_goes_on(
    train: Callable,
    tmp_path: Path,
    killing_a_rank: Callable,
    place: int,
    delay: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also on a busy machine, where the parent looks only when the other process has lost its peer."""
    wait = ranks_module.wait
    monkeypatch.setattr(
        ranks_module, "wait", lambda connections: [wait(connections), sleep(delay), wait(connections)][2]
    )
    words = ("model=mae_vz", "logger=none", "trainer.max_epochs=12", *TOGETHER)
    ranks = killing_a_rank(tmp_path / "runs", place)
    outcome = train(*words)
    assert len(ranks) == 2
    assert not any(alive(rank) for rank in ranks)
    assert f"rank {place} of 2: process {ranks[place]} was killed by SIGKILL" in outcome.error
    run = only_run(tmp_path / "runs")
    status = status_of(run)
    assert (status.state, "killed by SIGKILL" in str(status.error)) == ("failed", True)
    done = len(run.metrics())
    assert 1 < done < 13
    assert train(*words).status == 0
    assert [row["epoch"] for row in run.metrics()] == list(range(-1, 12))
    assert train(*words, "runs=whole").status == 0
    assert only_run(tmp_path / "whole").metrics() == run.metrics()


@pytest.mark.slow
def test_none_outlives_the_process_that_started_them(renders: Path, tmp_path: Path) -> None:
    from phd_exp.__main__ import main

    words = [*QUICK, f"data.root={renders}", f"runs={tmp_path}", "logger=none", "trainer.max_epochs=50", *TOGETHER]
    process = multiprocessing.get_context("spawn").Process(target=main, args=(words,))
    process.start()
    wait_until(lambda: list(tmp_path.rglob("last.ckpt")))
    ranks = descendants(process.pid)
    assert len(ranks) == 2
    process.kill()
    process.join()
    wait_until(lambda: not any(alive(rank) for rank in ranks))
    assert not only_run(tmp_path).is_held()


@pytest.mark.slow
@pytest.mark.parametrize(
    "launcher", [[], ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"], ["hydra/launcher=submitit_local"]]
)
def test_runs_of_a_sweep_under_any_launcher(train: Callable, tmp_path: Path, launcher: list[str]) -> None:
    """Two runs, each of two processes."""
    # joblib's workers outlive a sweep, with the working folder of their first one
    words = ("model=mae_vz", "logger=none", f"runs={tmp_path / 'runs'}", *TOGETHER)
    outcome = train("-m", "seed=0,1", *words, *launcher)
    assert outcome.status == 0, outcome.err
    runs = find_runs(tmp_path / "runs")
    assert [run.results()["devices"] for run in runs] == [2, 2]
    assert [run.results()["seed"] for run in runs] == [0, 1]
    assert train("seed=1", *words[:2], *TOGETHER, "runs=alone").status == 0
    assert only_run(tmp_path / "alone").metrics() == runs[1].metrics()

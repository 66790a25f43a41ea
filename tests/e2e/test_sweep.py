"""Sweeps on real renders: killed at any moment, with failures among them, with a configuration that has changed."""

import math
import os
import random
import re
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from importlib.util import find_spec
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, ClassVar

import pytest
from hydra.experimental.callback import Callback

from phd_exp.evaluation.parquet import read_table
from phd_exp.records.runs import RunFolder, find_runs
from tests.e2e.conftest import QUICK
from tests.support.processes import begin
from tests.support.recorded import stamps, weights

ONE = ("model=mae_vz", "recipe=strong", "data.image_size=64", "logger=none")
TWO = ("-m", *ONE, "seed=0,1")
SHORT = ("trainer.max_epochs=1", "backbone.width=8")
FOUR = ("-m", "experiment=table2", "model=mae_xyz,mae_constf", "seed=0,1", "logger=none")


def finished(runs: Path) -> dict[Path, dict[str, tuple[int, bytes]]]:
    """Every file of the finished runs: when it was written, and what it holds."""
    done = {run.path: stamps(run) for run in find_runs(runs) if run.is_finished()}
    return {run: {name: (at, (run / name).read_bytes()) for name, at in files.items()} for run, files in done.items()}


def numbers(runs: Path) -> dict[str, Any]:
    """What the runs of a folder came to, to the bit."""
    return {
        run.path.relative_to(runs).as_posix(): (run.results_file.read_bytes(), run.metrics(), weight_bytes(run))
        for run in find_runs(runs)
    }


def weight_bytes(run: RunFolder) -> dict[str, bytes]:
    return {name: weight.numpy().tobytes() for name, weight in weights(run).items()}


@pytest.fixture
def begun(renders: Path) -> Callable[..., BaseProcess]:
    preload = ["phd_exp.cli.train", "phd_exp.training.run"]
    return lambda *words: begin([*QUICK, f"data.root={renders}", *words], preload)


@pytest.mark.slow
def test_killed_at_any_moment_the_same_command_goes_on(train: Callable, begun: Callable, tmp_path: Path) -> None:
    """What is finished stays as it is, the rest comes to the numbers of one whole sweep, both to the bit."""
    assert train(*FOUR, f"runs={tmp_path / 'whole'}").status == 0
    runs, before = tmp_path / "killed", dict[Path, Any]()
    chance = random.Random(0)
    for _ in range(20):
        process = begun(*FOUR, f"runs={runs}")
        time.sleep(chance.uniform(0.5, 3))
        (process.kill if chance.random() < 0.5 else process.terminate)()
        process.join()
        now = finished(runs)
        assert {path: now[path] for path in before} == before
        before = now
    outcome = train(*FOUR, f"runs={runs}")
    assert outcome.status == 0, outcome.err
    now = finished(runs)
    assert f"{len(now)} jobs, {len(before)} of them finished already" in outcome.out
    assert {path: now[path] for path in before} == before
    assert numbers(runs) == numbers(tmp_path / "whole")
    for files in now.values():
        assert not [name for name in files if name.endswith(".tmp")]
        assert [name for name in files if name.startswith("checkpoints/")] == ["checkpoints/last.ckpt"]


@pytest.mark.slow
def test_a_preempted_job_comes_back_and_takes_up_its_run(train: Callable, begun: Callable, tmp_path: Path) -> None:
    """As SLURM does it: the queue tells the job by SIGUSR2, submitit puts it back, and it goes on where it was."""
    words = ("-m", "model=mae_vz", "seed=0", "logger=none", "trainer.max_epochs=12")
    assert train(*words, f"runs={tmp_path / 'whole'}").status == 0
    runs = tmp_path / "preempted"
    process = begun(*words, f"runs={runs}", "hydra/launcher=submitit_local", "hydra.launcher.timeout_min=60")
    while not list(runs.glob("*/*/*/*/checkpoints/last.ckpt")):
        assert process.is_alive()
        time.sleep(0.05)
    (told,) = jobs_of_submitit(runs)
    os.kill(told, signal.SIGUSR2)
    process.join()
    assert process.exitcode == 0
    (log,) = (runs / ".sweep" / ".submitit").glob("*/*_log.err")
    assert "this job is preempted" in log.read_text()
    assert numbers(runs) == numbers(tmp_path / "whole")


def jobs_of_submitit(runs: Path) -> list[int]:
    """The processes that work for submitit's folder below `runs`."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            command = (entry / "cmdline").read_bytes().decode().split("\0")
            if "submitit.core._submit" in command and any(word.startswith(str(runs)) for word in command):
                found.append(int(entry.name))
    return found


def test_runs_of_a_sweep_are_those_of_single_commands_and_never_reused_for_a_changed_configuration(
    train: Callable, tmp_path: Path
) -> None:
    outcome = train(*TWO, *SHORT)
    for seed in (0, 1):
        assert re.search(rf"^seed={seed}: finished, projected error \S+ mm, depth error \S+ mm$", outcome.out, re.M)
    (one, two) = sorted(find_runs(tmp_path / "runs"), key=lambda run: run.path.name)
    assert train(*ONE, *SHORT, "seed=1", "runs=alone").status == 0
    ((place, alone),) = numbers(tmp_path / "alone").items()
    assert numbers(tmp_path / "runs") == numbers(tmp_path / "runs") | {place: alone}

    config = two.config()
    config["optimizer"]["lr"] = 0.5  # as if the file under conf/ had changed since
    two.write_config(config)
    before = finished(tmp_path / "runs")
    assert before.keys() == {one.path, two.path}
    outcome = train(*TWO, *SHORT)
    assert outcome.status == 1
    (line,) = [line for line in outcome.err.splitlines() if line.startswith("error: ")]
    assert "seed=1 " in line
    assert "optimizer.lr=0.5, but optimizer.lr=0.002 is asked for" in line
    assert outcome.out.splitlines()[-1] == "2 jobs: 1 finished already, 1 failed"
    assert finished(tmp_path / "runs") == before


WITHOUT_RAY = pytest.mark.skipif(find_spec("ray") is None, reason="needs the extra `ray`, in a venv of its own")


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ["seed=1,0"],
        ["seed=1,0", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2"],
        ["seed=0,1", "hydra/launcher=submitit_local"],
        pytest.param(["seed=0,1", "hydra/launcher=ray"], marks=WITHOUT_RAY),
    ],
    ids=["order", "joblib", "submitit", "ray"],
)
def test_neither_order_nor_launcher_changes_a_number(train: Callable, tmp_path: Path, words: list[str]) -> None:
    """At one number of threads, which the shared words set."""
    assert train(*TWO, "runs=here").status == 0
    outcome = train("-m", *ONE, *words, "runs=there")
    assert outcome.status == 0, outcome.err
    assert numbers(tmp_path / "here") == numbers(tmp_path / "there")
    assert len(find_runs(tmp_path / "here")) == 2


class Received(Callback):
    """Keeps what a job returns to the sweeper, by its overrides."""

    scores: ClassVar[dict[tuple[str, str], float | None]] = {}

    def on_job_end(self, config: Any, job_return: Any, **rest: Any) -> None:
        self.scores[config.model.name, str(config.data.n_held_out)] = job_return.return_value


def test_the_score_is_that_of_the_held_out_samples_that_may_choose(own: Callable) -> None:
    axes = ("model=probabilistic,mae_vz", "data.n_held_out=7,0")
    callback = f"+hydra.callbacks.received._target_={__name__}.Received"
    outcome = own("-m", "hydra/sweeper=basic", callback, *axes, "trainer.max_epochs=1")
    assert outcome.status == 0, outcome.err
    for path in Path("runs").glob("*/*/*/seed*"):
        run = RunFolder(path)
        config = run.config()
        model, n = config["model"]["name"], config["data"]["n_held_out"]
        score = Received.scores.pop((model, str(n)))
        if n:
            table = read_table(run.held_out)
            name = "nll" if model == "probabilistic" else "depth_error_mm"
            assert len(table[name]) == n
            assert score == pytest.approx(math.fsum(table[name][::2]) / len(table[name][::2]))
        else:
            assert score is None
    assert not Received.scores, "a run for each job"
    lines = [line for line in outcome.out.splitlines() if "no score" in line]
    assert len(lines) == 2
    assert all("data.n_held_out" in line for line in lines)

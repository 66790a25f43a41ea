"""Whatever launcher runs the jobs of a sweep, wherever: all of them end, and every failure comes back."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from shutil import which

import pytest

HOME = Path(__file__).parents[2]
TINY = (
    "preset=smoke",
    "data.sensor_size=64",
    "data.f_range=[343,571]",
    "data.n_train=9",
    "data.n_test=3",
    "data.batch_size=8",
    "data.workers=1",
)
LAUNCHERS = {
    "joblib": ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"],
    "submitit": ["hydra/launcher=submitit_local"],
}
TASK = """
import os, signal, sys, time
from pathlib import Path
from phd_exp.cli.app import launch
from phd_exp.records.errors import UserError

def task(config, overrides, cores):
    seed = config["seed"]
    if seed == 1:
        raise UserError("a mistake")
    if seed == 2:
        raise ValueError("a fault")
    if seed == 3:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(60)
    if seed == 4:
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(60 if seed == 6 else 1)
    Path(f"{seed}.done").write_text(str(cores))
    return "done"

if __name__ == "__main__":
    sys.exit(launch(task, sys.argv[1:]))
"""


def call(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(HOME)}
    return subprocess.run(
        [sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True, timeout=200
    )


def errors(done: subprocess.CompletedProcess[str]) -> list[str]:
    return [line for line in done.stderr.splitlines() if line.startswith("error: ")]


def contents(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file() and ".cache" not in path.parts)
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.fixture
def sweep(tmp_path: Path):  # type: ignore[no-untyped-def]
    """A sweep of jobs that finish, fail and die, by their seed."""
    (tmp_path / "task.py").write_text(TASK)
    return lambda launcher, seeds: call(
        tmp_path, "task.py", "-m", f"seed={seeds}", "preset=smoke", *LAUNCHERS[launcher]
    )


@pytest.fixture(scope="module")
def unsharded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("unsharded")
    assert call(folder, "-m", "phd_exp", "render", *TINY).returncode == 0
    return contents(folder / "renders")


@pytest.mark.parametrize("launcher", ["joblib", pytest.param("submitit", marks=pytest.mark.slow)])
def test_shards_at_once_give_the_bytes_of_one_render(
    tmp_path: Path, unsharded: dict[str, bytes], launcher: str
) -> None:
    """A share that does not exist fails alone, and is named."""
    words = ("-m", "phd_exp", "-m", "render", *TINY, "shard=0/2,2/2,1/2", *LAUNCHERS[launcher])
    done = call(tmp_path, *words)
    assert done.returncode == 2
    (line,) = errors(done)
    assert "shard=2/2: shard: got '2/2'; expected INDEX/COUNT" in line
    assert contents(tmp_path / "renders") == unsharded
    assert {path.name for path in tmp_path.iterdir()} == {"renders", "runs"}


@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_failures_come_back_and_stop_no_other_job(sweep, tmp_path: Path, launcher: str) -> None:  # type: ignore[no-untyped-def]
    done = sweep(launcher, "0,1,2,3,5")
    assert done.returncode == 143
    heading, user, fault, stopped = errors(done)
    assert heading == "error: 3 runs failed"
    assert user == "error: seed=1 preset=smoke: a mistake"
    assert fault == "error: seed=2 preset=smoke: ValueError: a fault"
    assert "seed=3" in stopped
    assert "stopped by SIGTERM" in stopped
    assert {path.name for path in tmp_path.glob("*.done")} == {"0.done", "5.done"}
    assert len(list((tmp_path / "runs" / ".sweep").glob("launch-*/*.json"))) == 5


@pytest.mark.parametrize("launcher", ["joblib", pytest.param("submitit", marks=pytest.mark.slow)])
def test_a_job_that_is_killed_is_named(sweep, tmp_path: Path, launcher: str) -> None:  # type: ignore[no-untyped-def]
    done = sweep(launcher, "4,0")
    assert done.returncode == 1
    assert "seed=4 preset=smoke: ended without a word: it was killed" in "\n".join(errors(done))
    if launcher == "submitit":  # joblib ends all its processes when one of them dies
        assert len(errors(done)) == 1
        assert (tmp_path / "0.done").exists(), "jobs that still run are waited for"


def test_nothing_stays_of_a_launch_without_failures(sweep, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    done = sweep("joblib", "0,5")
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["2 jobs", "seed=0: done", "seed=5: done", "2 jobs: 2 done"]
    cores = max(1, len(os.sched_getaffinity(0)) // 2)
    assert [(tmp_path / f"{seed}.done").read_text() for seed in (0, 5)] == [str(cores)] * 2
    assert errors(done) == []
    assert not list((tmp_path / "runs" / ".sweep").glob("launch-*"))


@pytest.mark.slow
def test_jobs_of_a_queue_outlive_a_stopped_launcher(tmp_path: Path) -> None:
    """Stopped before its jobs begin, it leaves them the folder of their records."""
    (tmp_path / "task.py").write_text(TASK)
    words = [sys.executable, "task.py", "-m", "seed=0,5", "preset=smoke", *LAUNCHERS["submitit"]]
    environment = os.environ | {"PYTHONPATH": str(HOME)}
    launches = tmp_path / "runs" / ".sweep"
    with subprocess.Popen(words, cwd=tmp_path, env=environment, stderr=subprocess.DEVNULL) as launcher:
        wait_for(lambda: len(list(launches.glob(".submitit/*/*_submitted.pkl"))) == 2)
        assert not list(launches.glob("launch-*/*")), "no job has begun"
        launcher.send_signal(signal.SIGTERM)
        assert launcher.wait(60) == 143
    wait_for(lambda: len(list(launches.glob("launch-*/*.json"))) == 2)
    assert {path.name for path in tmp_path.glob("*.done")} == {"0.done", "5.done"}


def test_jobs_of_joblib_end_with_a_killed_launcher(tmp_path: Path) -> None:
    """Those that have begun, and those that were handed out and have not."""
    (tmp_path / "task.py").write_text(TASK)
    words = [sys.executable, "task.py", "-m", "seed=6", "preset=smoke,small,paper,demo", *LAUNCHERS["joblib"]]
    environment = os.environ | {"PYTHONPATH": str(HOME)}
    with subprocess.Popen(words, cwd=tmp_path, env=environment, stderr=subprocess.DEVNULL) as launcher:
        wait_for(lambda: len(list(tmp_path.glob("runs/.sweep/launch-*/*.begun"))) == 2)
        launcher.kill()
    (records,) = tmp_path.glob("runs/.sweep/launch-*")
    wait_for(lambda: {"0.json", "1.json"} <= {file.name for file in records.glob("*.json")})
    time.sleep(0.5)
    for file in records.glob("*.json"):
        assert "stopped by SIGTERM" in file.read_text()
    assert not list(tmp_path.glob("*.done"))


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.02)


@pytest.mark.skipif(which("srun") is not None, reason="needs a machine without SLURM")
def test_a_launcher_that_cannot_begin_is_one_line(phd_exp: Callable, tmp_path: Path) -> None:
    outcome = phd_exp("-m", "render", *TINY, "shard=0/2,1/2", "hydra/launcher=submitit_slurm")
    assert outcome.status == 1
    (line,) = outcome.err.splitlines()
    assert line.startswith("error: the launcher failed before any job began (RuntimeError: Could not detect")
    assert not list(tmp_path.glob("runs/.sweep/launch-*"))

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
from phd_exp.cli.frame import run_verb
from phd_exp.records.errors import UserError

def task(config, overrides, cores):
    seed = config["seed"]
    Path(f"{seed}.begun").touch()
    if seed == 1:
        raise UserError("a mistake")
    if seed == 2:
        raise ValueError("a fault")
    if seed == 3:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(60)
    if seed == 4:
        os.kill(os.getpid(), signal.SIGKILL)
    if seed == 6:
        Path(f"{config['preset']}.asleep").touch()
        try:
            time.sleep(60)
        finally:
            Path(f"{config['preset']}.awake").touch()
    time.sleep(1)
    Path(f"{seed}.done").write_text(str(cores))
    return seed / 2

def standing(config, overrides):
    done, begun = (Path(f"{config['seed']}.{state}") for state in ("done", "begun"))
    return "finished" if done.exists() else "killed" if begun.exists() else None

if __name__ == "__main__":
    sys.exit(run_verb(lambda words: launch(task, words, standing=standing), sys.argv[1:]))
"""

SCORES = """
from hydra.experimental.callback import Callback

class Scores(Callback):
    def on_job_end(self, config, job_return, **rest):
        print("score", job_return.return_value)
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


@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_failures_come_back_and_stop_no_other_job(sweep, tmp_path: Path, launcher: str) -> None:  # type: ignore[no-untyped-def]
    done = sweep(launcher, "0,1,2,3,5")
    assert done.returncode == 143
    heading, user, fault, stopped = errors(done)
    assert heading == "error: 3 jobs failed"
    assert user == "error: seed=1 preset=smoke: a mistake"
    assert fault == "error: seed=2 preset=smoke: ValueError: a fault"
    assert "seed=3" in stopped
    assert "stopped by SIGTERM" in stopped
    assert {path.name for path in tmp_path.glob("*.done")} == {"0.done", "5.done"}


@pytest.mark.parametrize("launcher", ["joblib", pytest.param("submitit", marks=pytest.mark.slow)])
def test_a_job_that_is_killed_is_named(sweep, tmp_path: Path, launcher: str) -> None:  # type: ignore[no-untyped-def]
    done = sweep(launcher, "4,0")
    assert done.returncode == 1
    assert "error: seed=4 preset=smoke: killed; the same command resumes" in errors(done)
    if launcher == "submitit":  # joblib ends all its processes when one of them dies
        assert len(errors(done)) == 1


def test_jobs_at_once_share_the_cores_and_say_who_they_are(sweep, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    done = sweep("joblib", "0,5")
    assert done.returncode == 0, done.stderr
    first, *headers, zero, five, total = done.stdout.splitlines()
    assert first == "2 jobs, 0 of them finished already"
    assert sorted(headers) == ["job 1/2: seed=0 preset=smoke", "job 2/2: seed=5 preset=smoke"]
    assert (zero, five, total) == ("seed=0: finished", "seed=5: finished", "2 jobs: 2 finished")
    cores = max(1, len(os.sched_getaffinity(0)) // 2)
    assert [(tmp_path / f"{seed}.done").read_text() for seed in (0, 5)] == [str(cores)] * 2
    assert errors(done) == []


def test_a_sweeper_of_others_gets_the_number_of_each_job_and_stops_at_an_error(tmp_path: Path) -> None:
    """Hydra's own; a job returns what a sweeper minimizes."""
    (tmp_path / "task.py").write_text(TASK)
    (tmp_path / "scores.py").write_text(SCORES)
    words = ("task.py", "-m", "preset=smoke", "hydra/sweeper=basic")
    done = call(tmp_path, *words, "seed=5,0", "+hydra.callbacks.scores._target_=scores.Scores")
    assert [line for line in done.stdout.splitlines() if "score" in line] == ["score 2.5", "score 0.0"]
    failed = call(tmp_path, *words, "seed=1,0")
    assert (failed.returncode, errors(failed)) == (1, ["error: a mistake"])


@pytest.mark.slow
def test_jobs_of_a_queue_outlive_a_stopped_launcher(tmp_path: Path) -> None:
    (tmp_path / "task.py").write_text(TASK)
    words = [sys.executable, "task.py", "-m", "seed=0,5", "preset=smoke", *LAUNCHERS["submitit"]]
    environment = os.environ | {"PYTHONPATH": str(HOME)}
    launches = tmp_path / "runs" / ".sweep"
    with subprocess.Popen(words, cwd=tmp_path, env=environment, stderr=subprocess.DEVNULL) as launcher:
        wait_for(lambda: len(list(launches.glob(".submitit/*/*_submitted.pkl"))) == 2)
        assert not list(tmp_path.glob("*.begun")), "no job has begun"
        launcher.send_signal(signal.SIGTERM)
        assert launcher.wait(60) == 143
    wait_for(lambda: {path.name for path in tmp_path.glob("*.done")} == {"0.done", "5.done"})


def test_jobs_of_joblib_end_with_a_killed_launcher(tmp_path: Path) -> None:
    """Those that have begun, and those that were handed out and have not."""
    (tmp_path / "task.py").write_text(TASK)
    words = [sys.executable, "task.py", "-m", "seed=6", "preset=smoke,small,paper,demo", *LAUNCHERS["joblib"]]
    environment = os.environ | {"PYTHONPATH": str(HOME)}
    with subprocess.Popen(words, cwd=tmp_path, env=environment, stderr=subprocess.DEVNULL) as launcher:
        wait_for(lambda: len(list(tmp_path.glob("*.asleep"))) == 2)
        launcher.kill()
    wait_for(lambda: len(list(tmp_path.glob("*.awake"))) >= 2)
    time.sleep(0.5)
    assert len(list(tmp_path.glob("*.awake"))) == len(list(tmp_path.glob("*.asleep")))
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
    assert line.startswith("error: the launcher failed (RuntimeError: Could not detect")

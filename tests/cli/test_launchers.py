"""With any launcher, in any process: every job of a sweep ends, and every failure comes back."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from shutil import which
from types import SimpleNamespace
from typing import Any

import pytest
from hydra.core.plugins import Plugins
from hydra.experimental.callback import Callback

from phd_exp.cli.frame import run_verb
from phd_exp.cli.jobs import Job, launch
from phd_exp.records.errors import UserError
from tests.support.renders import wait_until

LAUNCHERS = {
    "joblib": ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"],
    "submitit": ["hydra/launcher=submitit_local"],
}
PROGRAMME = "import sys; from tests.cli.test_launchers import main; sys.exit(main(sys.argv[1:]))"


def task(config: dict[str, Any], overrides: list[str], cores: int) -> float:
    """A job that finishes, fails or dies, by its seed."""
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
    time.sleep(0.3)
    Path(f"{seed}.done").write_text(str(cores))
    return float(seed / 2)


def standing(config: dict[str, Any], overrides: list[str]) -> str | None:
    done, begun = (Path(f"{config['seed']}.{state}") for state in ("done", "begun"))
    return "finished" if done.exists() else "killed" if begun.exists() else None


def main(words: list[str]) -> int:
    return run_verb(lambda rest: launch(Job(task, standing), rest), words)


class Scores(Callback):
    """Prints what Hydra's own sweeper receives from each job."""

    def on_job_end(self, config: Any, job_return: Any, **rest: Any) -> None:
        print("score", job_return.return_value)


@pytest.fixture
def begin(tmp_path: Path) -> Callable[..., subprocess.Popen[str]]:
    """A sweep in a process of its own."""
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    return lambda launcher, *words: subprocess.Popen(
        [sys.executable, "-c", PROGRAMME, "-m", *words, *LAUNCHERS[launcher]],
        cwd=tmp_path, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


@pytest.fixture
def sweep(begin: Callable) -> Callable[..., tuple[int, list[str], list[str]]]:
    """A whole sweep over seeds: its status, its lines and its errors."""

    def run(launcher: str, seeds: str) -> tuple[int, list[str], list[str]]:
        with begin(launcher, f"seed={seeds}", "preset=smoke") as process:
            out, err = process.communicate(timeout=200)
        errors = [line for line in err.splitlines() if line.startswith("error: ")]
        return process.returncode, out.splitlines(), errors

    return run


@pytest.mark.slow
@pytest.mark.parametrize(("launcher", "seeds"), [("joblib", (0, 1, 2, 3, 5)), ("submitit", (0, 1, 3))])
def test_failures_come_back_and_stop_no_other_job(
    sweep: Callable, tmp_path: Path, launcher: str, seeds: tuple[int, ...]
) -> None:
    status, lines, errors = sweep(launcher, ",".join(map(str, seeds)))
    wrong = {1: "a mistake", 2: "ValueError: a fault", 3: "stopped by SIGTERM; the same command resumes"}
    expected = [f"error: seed={seed} preset=smoke: {wrong[seed]}" for seed in seeds if seed in wrong]
    without_place = [re.sub(r" \(/.*, line \d+\); mend it, and .*", "", error) for error in errors]
    assert (status, without_place) == (143, [f"error: {len(expected)} jobs failed", *expected])
    assert lines[0] == f"{len(seeds)} jobs, 0 of them finished already"
    outcomes = {1: "failed", 2: "failed", 3: "interrupted"}
    *_, total = lines
    assert lines[-1 - len(seeds) : -1] == [f"seed={s}: {outcomes.get(s, 'finished')}" for s in seeds]
    assert total.startswith(f"{len(seeds)} jobs: {len(seeds) - len(expected)} finished, ")
    assert {path.name for path in tmp_path.glob("*.done")} == {f"{s}.done" for s in seeds if s not in wrong}
    if launcher == "joblib":  # the output of submitit's jobs is in its logs
        headers = [f"job {i}/5: seed={seed} preset=smoke" for i, seed in enumerate(seeds, 1)]
        assert sorted(line for line in lines if line.startswith("job ")) == headers
        cores = max(1, len(os.sched_getaffinity(0)) // 2)  # two jobs at once share them
        assert [(tmp_path / f"{seed}.done").read_text() for seed in (0, 5)] == [str(cores)] * 2


def test_a_killed_job_is_named_and_others_keep_their_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["task"])
    (tmp_path / "5.done").touch()

    def launch(*arguments: Any, **named: Any) -> None:
        Path("7.begun").touch()
        raise RuntimeError("a worker died")  # as joblib and submitit do

    launcher = SimpleNamespace(launch=launch)
    monkeypatch.setattr(Plugins, "instantiate_launcher", lambda *arguments, **named: launcher)
    assert main(["-m", "preset=smoke", "seed=5,7,0"]) == 1
    out, err = capfd.readouterr()
    assert "3 jobs: 1 finished already, 1 failed, 1 not started\n" in out
    assert err.splitlines() == [
        "error: 2 jobs failed",
        "error: preset=smoke seed=7: killed; the same command resumes",
        "error: preset=smoke seed=0: did not start; the same command resumes",
    ]


@pytest.mark.slow
@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_a_launcher_with_a_killed_process_names_its_job(sweep: Callable, launcher: str) -> None:
    status, _, errors = sweep(launcher, "4,0")
    assert status == 1
    assert "error: seed=4 preset=smoke: killed; the same command resumes" in errors
    if launcher == "submitit":  # joblib ends all its processes when one of them dies
        assert len(errors) == 1


def test_other_sweepers_receive_the_score_of_each_job_and_stop_at_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["task"])
    words = ("-m", "preset=smoke", "hydra/sweeper=basic")
    assert main([*words, "seed=5,0", f"+hydra.callbacks.scores._target_={__name__}.Scores"]) == 0
    out = capfd.readouterr().out
    assert [line for line in out.splitlines() if "score" in line] == ["score 2.5", "score 0.0"]
    assert main([*words, "seed=1,0"]) == 1
    assert capfd.readouterr().err.splitlines()[-1] == "error: a mistake"


def test_keys_of_a_part_that_an_experiment_chooses_can_be_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["task"])
    found = []

    def keep(config: dict[str, Any], overrides: list[str], cores: int) -> None:
        found.append((config["backbone"]["width"], overrides))

    job = Job(keep)
    words = ["-m", "experiment=speed", "seed=1", "backbone.width=8", "data.f_range=[1200, 1500]"]
    assert launch(job, words) == 0, capfd.readouterr().err
    ((width, overrides),) = found
    assert width == 8
    assert overrides[-3:] == ["seed=1", "backbone.width=8", "data.f_range=[1200,1500]"]
    assert launch(Job(job.task), [*words, "backbone.widt=8"]) == 2
    assert "backbone.widt: " in capfd.readouterr().err


@pytest.mark.slow
def test_queued_jobs_outlive_a_stopped_launcher(begin: Callable, tmp_path: Path) -> None:
    with begin("submitit", "seed=0,5", "preset=smoke") as launcher:
        submitted = tmp_path / "runs" / ".sweep"
        wait_until(lambda: len(list(submitted.glob(".submitit/*/*_submitted.pkl"))) == 2)
        assert not list(tmp_path.glob("*.begun")), "no job has begun"
        launcher.send_signal(signal.SIGTERM)
        assert launcher.wait(60) == 143
    wait_until(lambda: {path.name for path in tmp_path.glob("*.done")} == {"0.done", "5.done"})


@pytest.mark.slow
def test_jobs_of_joblib_end_with_a_killed_launcher(begin: Callable, tmp_path: Path) -> None:
    """Running jobs end, and jobs that a worker has received but not begun."""
    with begin("joblib", "seed=6", "preset=smoke,small,paper,demo") as launcher:
        wait_until(lambda: len(list(tmp_path.glob("*.asleep"))) == 2)
        launcher.kill()
        wait_until(lambda: len(list(tmp_path.glob("*.awake"))) >= 2)
    time.sleep(0.5)
    assert len(list(tmp_path.glob("*.awake"))) == len(list(tmp_path.glob("*.asleep")))
    assert not list(tmp_path.glob("*.done"))


@pytest.mark.skipif(which("srun") is not None, reason="needs a machine without SLURM")
def test_a_launcher_that_cannot_start_is_one_line(phd_exp: Callable) -> None:
    outcome = phd_exp("-m", "render", "preset=smoke", "shard=0/2,1/2", "hydra/launcher=submitit_slurm")
    assert outcome.error.startswith("the launcher failed (RuntimeError: ")

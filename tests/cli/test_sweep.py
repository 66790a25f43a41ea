"""What a sweep is, before anything runs: its jobs, where they go, and how many cores each has."""

import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hydra.types import RunMode
from omegaconf import OmegaConf

from phd_exp.cli import conf_folder
from phd_exp.cli import jobs as launched
from phd_exp.cli.jobs import Job
from phd_exp.cli.sweep import Combination, cores_a_job, plan
from phd_exp.cli.train import numbers, run_name, standing
from phd_exp.cli.words import in_conf
from phd_exp.config import check
from phd_exp.records.processes import usable_cores
from phd_exp.records.runs import RunFolder
from tests.support.recorded import status_of

EXPERIMENTS = [
    pytest.param(file.stem, marks=pytest.mark.slow if file.stem in ("heads", "shift") else ())
    for file in sorted((conf_folder() / "experiment").iterdir())
]


@pytest.fixture
def jobs() -> Iterator[Callable[..., list[Combination]]]:
    """The jobs that the words of a command line stand for."""
    with in_conf():
        yield lambda *words: plan(list(words), "config")[1]


def folder(job: Combination) -> Path:
    config = check(job.config)
    return run_name(config, job.overrides).folder(config.runs)


@pytest.mark.parametrize(
    ("words", "n"),
    [
        (["experiment=fusion", "seed=0,1", "evaluation.multiview.scenes=7"], 2),
        (["experiment=track", "seed=0,1", "evaluation.sequences=[[4,20]]"], 6),
        (["experiment=glob(table*)", "data=occl"], 5),
        (["data=occl", "experiment=table1", "model=mae_vz,probabilistic"], 2),
        (["seed=0,0,1,0"], 2),
        (["logger=none"], 1),
    ],
)
def test_as_many_runs_as_the_words_say(jobs: Callable, words: list[str], n: int) -> None:
    found = [folder(job) for job in jobs(*words)]
    assert len(found) == len(set(found)) == n


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_an_experiment_says_how_many_runs_it_has_and_changes_nothing_else(jobs: Callable, experiment: str) -> None:
    """The run of (mae_vz, occl) in Table 1 is the run of that model on that data, in the same folder."""
    text = (conf_folder() / "experiment" / f"{experiment}.yaml").read_text()
    words = ["seed=3", "optimizer.lr=1e-2", "preset=small"]
    found = {folder(job): job for job in jobs(f"experiment={experiment}", *words)}
    assert f"\n# Runs: {len(found)}" in text
    assert f"python -m phd_exp -m experiment={experiment}" in text
    for job in found.values():
        assert (job.config["seed"], job.config["optimizer"]["lr"], job.config["preset"]) == (3, 1e-2, "small")
        keys = [override.split("=")[0] for override in job.overrides]
        assert len(keys) == len(set(keys))
    if experiment == "table1":
        (alone,) = jobs("model=mae_vz", "data=occl", *words)
        assert found[folder(alone)].config == alone.config


def test_jobs_in_a_queue_come_back() -> None:
    with in_conf():
        master, _ = plan(["hydra/launcher=slurm", "hydra.launcher.partition=gpu"], "config")
    launcher = master.hydra.launcher
    assert launcher["_target_"].endswith("SlurmLauncher")
    assert (launcher["timeout_min"], launcher["max_num_timeout"], launcher["partition"]) == (1440, 10, "gpu")


def test_how_a_run_stands_is_read_before_the_configuration_is_checked(
    jobs: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    planned = jobs("experiment=table2", "preset=smoke", "optimizer.lr=0.01", "data.xy_range=0.5")
    runs = [RunFolder(folder(job)) for job in planned]
    for run in runs[1:]:
        run.path.mkdir(parents=True)
    with runs[2].held(), runs[2].recording(data_manifest=None):
        assert [standing(job.config, job.overrides) for job in planned] == [None, None, "running"]
    with suppress(ValueError), runs[1].recording(data_manifest=None):
        raise ValueError("planted")
    found = [standing(job.config, job.overrides) for job in planned]
    assert found == [None, "ValueError: planted", "finished"]
    (shifted,) = jobs(*planned[2].overrides, "shift=focal_length")
    assert folder(shifted) == folder(planned[2]), "a shift does not change the run"
    assert standing(shifted.config, shifted.overrides) == "interrupted"
    runs[2].shifts.mkdir()
    runs[2].shift("f_wrong").touch()
    assert standing(shifted.config, shifted.overrides) == "finished"
    status_of(runs[1], state="running")
    assert standing(planned[1].config, planned[1].overrides) == "exited without a result (killed or out of memory)"


@pytest.mark.parametrize(
    ("launcher", "jobs_", "expected"),
    [
        ({"_target_": "hydra.BasicLauncher"}, 8, None),
        ({"_target_": "submitit.SlurmLauncher"}, 8, None),
        ({"_target_": "submitit.LocalLauncher"}, 3, 4),
        ({"_target_": "submitit.LocalLauncher"}, 30, 1),
        *(
            ({"_target_": "joblib.JoblibLauncher", "n_jobs": n}, 8, each)
            for n, each in ((1, 12), (2, 6), (5, 2), (20, 1), (-1, 1), (-5, 1), (-11, 6), (-50, 12))
        ),
    ],
)
def test_jobs_at_once_share_the_cores(
    monkeypatch: pytest.MonkeyPatch, launcher: dict[str, Any], jobs_: int, expected: int | None
) -> None:
    monkeypatch.delenv("SLURM_CPUS_PER_TASK", raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(16)))
    assert usable_cores() == 16
    for granted, usable in (("64", 16), ("", 16), ("12", 12)):
        monkeypatch.setenv("SLURM_CPUS_PER_TASK", granted)
        assert usable_cores() == usable
    assert cores_a_job(launcher, jobs_) == expected


def test_the_numbers_of_a_finished_run_are_its_errors_and_its_nll(
    jobs: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    errors = {"test/projected_error_mm": 6.25, "test/depth_error_mm": 142.0}
    for job, nll in zip(jobs("preset=smoke", "model=probabilistic,mae_vz"), ({"test/nll": -8.5}, {}), strict=True):
        run = RunFolder(folder(job))
        run.path.mkdir(parents=True)
        run.write_results(errors | nll)
        expected = f"projected error 6.25 mm, depth error 142 mm{', NLL -8.5' if nll else ''}"
        assert numbers(job.config, job.overrides) == expected
        assert numbers(job.config | {"seed": None}, job.overrides) == "", "as a job that is refused"
        for change in ({"data": 3}, {"model": {}}, {"runs": None}, {"seed": [1]}):
            assert standing(job.config | change, job.overrides) is None, change


@pytest.mark.parametrize(("launcher", "worker", "share", "seen"), [
    (None, "1", 6, None), ("3", "1", 6, "3"), ("3", "2", None, "2"), (None, "2", None, "2"),
])  # fmt: skip
def test_a_job_that_shares_the_cores_has_the_omp_threads_of_its_launcher(
    monkeypatch: pytest.MonkeyPatch, launcher: str | None, worker: str, share: int | None, seen: str | None
) -> None:
    """Launchers set OMP_NUM_THREADS by their number of processes, however many jobs there are."""
    monkeypatch.delenv(launched.OMP, raising=False)
    if launcher:
        monkeypatch.setenv(launched.OMP, launcher)
    job = Job(lambda *_: os.environ.get(launched.OMP), cores=share)  # type: ignore[arg-type, return-value]
    here = SimpleNamespace(mode=RunMode.MULTIRUN, overrides=SimpleNamespace(task=[]), job=SimpleNamespace(num=0))
    monkeypatch.setattr(launched.HydraConfig, "get", lambda: here)
    monkeypatch.setenv(launched.OMP, worker)
    assert job._run(OmegaConf.create({})) == seen

"""From the command line to a run record, on real renders."""

import json
import math
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch
from PIL import Image

from phd_exp.evaluation.point_errors import QUANTITIES, ErrorKey
from phd_exp.records.runs import RunFolder, find_runs
from phd_exp.reports.runs import read_report
from tests.e2e.runs import only_run, weights

MODELS = ("probabilistic", "mae_vz", "mae_logz", "mae_xyz", "mae_constf")
DATA = (
    pytest.param("default", marks=pytest.mark.slow),
    pytest.param("occl", marks=pytest.mark.slow),
    pytest.param("scale", marks=pytest.mark.slow),
    "occl_scale",
)
"""The last one is both of those before it, and every other test is on the first."""
ERRORS = {"loss", "projected_error_mm", "depth_error_mm"}
OF_A_DISTRIBUTION = {"nll", "depth_precision", "projected_precision"}
CALIBRATION = {"depth_ence", "projected_ence", "miscalibration_area", "depth_crps_mm", "left_out"}


@pytest.mark.parametrize("model", MODELS)
def test_every_model_leaves_a_whole_record(train: Callable, tmp_path: Path, model: str) -> None:
    outcome = train(f"model={model}", "logger=none")
    assert outcome.status == 0, outcome.err
    run = only_run(tmp_path / "runs")
    assert run.path.relative_to(tmp_path).as_posix().startswith(f"runs/smoke/default/{model}/seed0-")
    assert run.is_finished()
    quantities = ERRORS | (OF_A_DISTRIBUTION if model == "probabilistic" else set())
    untrained, *rows = run.metrics()
    assert untrained["epoch"] == -1
    assert [row["epoch"] for row in rows] == [0, 1]
    for row in rows:
        assert {f"{split}/{name}" for split in ("train", "test") for name in quantities} <= row.keys()
        assert all(math.isfinite(value) for value in row.values())
    results = run.results()
    of_test = {key: value for key, value in rows[-1].items() if key.startswith("test/")}
    assert of_test == pytest.approx({key: results[key] for key in of_test}, rel=1e-6)  # logged in float32
    scores = {f"test/calibration/{name}" for name in CALIBRATION}
    assert scores & of_test.keys() == (scores if model == "probabilistic" else set())
    table = pd.read_parquet(run.predictions)
    assert len(table) == 6
    scored = {"depth_pit", "depth_crps", "energy_score"}
    assert scored & set(table.columns) == (scored if model == "probabilistic" else set())
    assert "depth_precision" not in table  # it is a
    for name in ("projected_error_mm", "depth_error_mm"):
        assert results[f"test/{name}"] == pytest.approx(table[name].mean())
        assert results[f"untrained/test/{name}"] == untrained[f"test/{name}"]
    held_out = pd.read_parquet(run.held_out)
    assert list(held_out.columns) == list(table.columns)
    assert held_out["file_name"].tolist() == [f"{index:06d}.png" for index in range(16, 20)]
    assert (results["n_train"], results["n_held_out"], results["n_test"]) == (16, 4, 6)


@pytest.mark.parametrize("data", DATA)
def test_every_data_set_trains(train: Callable, tmp_path: Path, data: str) -> None:
    outcome = train(f"data={data}", "logger=none")
    assert outcome.status == 0, outcome.err
    assert only_run(tmp_path / "runs").results()["data"] == data


def test_calibration_as_data_and_as_pictures(train: Callable, tmp_path: Path) -> None:
    assert train("logger=none", "evaluation.calibration_every_n_epochs=1").status == 0
    run = only_run(tmp_path / "runs")
    for name in ("epoch-0000", "epoch-0001", "final"):
        curves = json.loads((run.calibration / f"{name}.json").read_text())
        assert curves.keys() == {"depth", "projected"}
        for curve in curves.values():
            assert len(curve["predicted"]) == len(curve["empirical"]) == 6 - curve["window"] + 1
        with Image.open(run.calibration / f"{name}.png") as picture:
            assert picture.size[0] > 500


@pytest.mark.slow
def test_evaluating_less_often_changes_no_number_but_leaves_some_out(train: Callable, tmp_path: Path) -> None:
    for every in (1, 2):
        outcome = train(
            "logger=none", f"runs={tmp_path / str(every)}", "trainer.max_epochs=3",
            f"evaluation.every_n_epochs={every}",
        )  # fmt: skip
        assert outcome.status == 0, outcome.err
    each, other = (only_run(tmp_path / name) for name in "12")
    for (name, weight), (_, same) in zip(weights(each).items(), weights(other).items(), strict=True):
        assert torch.equal(weight, same), name
    of_each, of_other = list(each.metrics()), list(other.metrics())
    assert [any(key.startswith("test/") for key in row) for row in of_other] == [True, False, True, False]
    for row, same in zip(of_each, of_other, strict=True):
        assert same.items() <= row.items()
    assert {
        key: value for key, value in each.results().items() if "test/" in key
    }.items() <= other.results().items()


def test_wandb_beside_the_record(train: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And nowhere else: neither at home nor in the environment of the next run."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    before = dict(os.environ)
    assert train("model=probabilistic").status == 0
    assert not list((tmp_path / "home").rglob("*wandb*"))
    assert {name for name in os.environ if name.startswith("WANDB_")} - before.keys() == set()
    run = only_run(tmp_path / "runs")
    (offline,) = (run.path / "wandb").glob("offline-run-*")
    assert list(offline.glob("run-*.wandb"))
    assert list(offline.glob("files/media/images/test/calibration*.png"))


def in_wandb_viewer(run: RunFolder, *words: str) -> str:
    """What wandb's own viewer prints of the one offline run."""
    (offline,) = run.wandb.glob("offline-run-*")
    command = [sys.executable, "-m", "wandb", "leet", "inspect", "--json", *words, str(offline)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


@pytest.mark.slow
def test_wandb_ends_as_the_run_ended(
    train: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One run of theirs: failed where ours failed; whole, from the first epoch on, when ours was resumed."""
    from phd_exp.training.module import PositionModule

    with monkeypatch.context() as patch:
        patch.setattr(PositionModule, "on_train_epoch_end", power_cut_in_epoch_1)
        assert train("evaluation.calibration_every_n_epochs=1").status == 1
    run = only_run(tmp_path / "runs")
    assert json.loads(in_wandb_viewer(run, "--summary"))["state"] == "failed"

    assert train("evaluation.calibration_every_n_epochs=1").status == 0
    seen = json.loads(in_wandb_viewer(run, "--summary"))
    assert seen["state"] == "finished"
    results = run.results()
    assert {key: seen["summary"][key] for key in results} == pytest.approx(results)
    assert seen["config"]["model"]["name"] == "probabilistic"
    records = [json.loads(line) for line in in_wandb_viewer(run).splitlines()]
    items = [record["history"]["item"] for record in records if record["type"] == "history"]
    errors = {item["epoch"]: item["test/depth_error_mm"] for item in items if "test/depth_error_mm" in item}
    assert errors == pytest.approx({row["epoch"]: row["test/depth_error_mm"] for row in run.metrics()})
    pictures = [item for item in items if "test/calibration._type" in item or "test/calibration" in item]
    assert len(pictures) == 3  # of two epochs, and the end


def power_cut_in_epoch_1(self: Any) -> None:
    if self.current_epoch == 1:
        raise RuntimeError("power cut")
    self.training_rows.reset()


@pytest.mark.slow
def test_without_a_logger_no_trace_of_wandb(train: Callable, tmp_path: Path) -> None:
    assert train("logger=none").status == 0
    assert not list(tmp_path.rglob("*wandb*"))


@pytest.mark.parametrize("terminal", [True, False])
def test_progress_is_a_bar_on_a_terminal_and_lines_elsewhere(
    train: Callable, monkeypatch: pytest.MonkeyPatch, terminal: bool
) -> None:
    monkeypatch.setattr("phd_exp.training.build.on_a_terminal", lambda: terminal)
    outcome = train("model=mae_vz", "logger=none", "trainer.progress_bar=true")
    assert outcome.status == 0, outcome.err
    assert ("epoch 2/2: test/loss" in outcome.out) is not terminal
    assert ("Epoch 1: 100%" in outcome.out + outcome.err) is terminal


def test_a_finished_run_is_not_run_again(train: Callable, tmp_path: Path) -> None:
    assert train("logger=none").status == 0
    before = only_run(tmp_path / "runs").results_file.stat().st_mtime_ns
    again = train("logger=none")
    assert again.status == 0
    assert "finished already" in again.out
    assert only_run(tmp_path / "runs").results_file.stat().st_mtime_ns == before


def test_a_run_of_another_configuration_is_never_reused(train: Callable, tmp_path: Path) -> None:
    assert train("logger=none").status == 0
    run = only_run(tmp_path / "runs")
    config = run.config()
    config["optimizer"]["lr"] = 0.5  # as if the file under conf/ had changed since
    run.write_config(config)
    outcome = train("logger=none")
    assert outcome.status == 1
    assert "optimizer.lr=0.5, but optimizer.lr=0.001 is asked for" in outcome.err


@pytest.mark.parametrize("recipe", [pytest.param("paper", marks=pytest.mark.slow), "strong"])
def test_a_broken_run_goes_on_where_it_was(
    train: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recipe: str
) -> None:
    from phd_exp.training.module import PositionModule

    long = ("logger=none", "trainer.max_epochs=4", f"recipe={recipe}", "data.image_size=64")
    assert train(*long, "runs=whole").status == 0
    whole = only_run(tmp_path / "whole")

    validation_step = PositionModule.validation_step

    def power_cut(self: PositionModule, *arguments: Any) -> Any:
        if self.current_epoch == 2:
            raise RuntimeError("power cut")
        return validation_step(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(PositionModule, "validation_step", power_cut)
        broken = train(*long, "runs=broken")
    assert broken.status == 1
    assert "RuntimeError: power cut" in broken.err
    run = only_run(tmp_path / "broken")
    status = run.status()
    assert status is not None
    assert (status.state, status.error) == ("failed", "RuntimeError: power cut")

    resumed = train(*long, "runs=broken")
    assert (resumed.status, "resuming at epoch 3 of 4" in resumed.out) == (0, True)
    assert [row["epoch"] for row in run.metrics()] == [-1, 0, 1, 2, 3]
    assert run.metrics() == whole.metrics()
    assert run.results_file.read_bytes() == whole.results_file.read_bytes()


def test_an_epoch_is_recorded_before_there_is_a_checkpoint_of_it(
    train: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that ends right after writing one goes on with the next epoch, and misses no number of this."""
    from phd_exp.training.checkpoints import AtomicCheckpoints

    assert train("model=mae_vz", "logger=none", "runs=whole").status == 0
    save_checkpoint = AtomicCheckpoints.save_checkpoint

    def power_cut(self: AtomicCheckpoints, *arguments: Any) -> None:
        save_checkpoint(self, *arguments)
        raise RuntimeError("power cut")

    with monkeypatch.context() as patch:
        patch.setattr(AtomicCheckpoints, "save_checkpoint", power_cut)
        assert train("model=mae_vz", "logger=none").status == 1
    run = only_run(tmp_path / "runs")
    assert [row["epoch"] for row in run.metrics()] == [-1, 0]
    assert train("model=mae_vz", "logger=none").status == 0
    assert run.metrics() == only_run(tmp_path / "whole").metrics()


def test_the_untrained_network_gives_the_middle_of_the_data_set(train: Callable, tmp_path: Path) -> None:
    assert train("logger=none").status == 0
    run = only_run(tmp_path / "runs")
    table = pd.read_parquet(run.predictions)
    mu_z0 = math.sqrt((3 / 571) * (5 / 343))
    z = mu_z0 * table["f"]
    along = (z * table["z"]) / (table[["x", "y", "z"]] ** 2).sum(axis=1)
    depth_error = (along - 1).abs() * (table[["x", "y", "z"]] ** 2).sum(axis=1) ** 0.5
    assert run.results()["untrained/test/depth_error_mm"] == pytest.approx(
        1000 * depth_error.mean(), rel=1e-4
    )


@pytest.mark.parametrize(
    ("name", "status", "batch"),
    [("SIGTERM", 143, 1), pytest.param("SIGINT", 130, 0, marks=pytest.mark.slow)],
)
def test_a_signal_stops_after_the_batch_and_the_run_goes_on_with_the_next(
    train: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, status: int, batch: int
) -> None:
    from phd_exp.training.module import PositionModule

    words = (
        "logger=none",
        "data.batch_size=4",
        "recipe=strong",
        "data.image_size=64",
        "recipe.warmup_steps=2",
    )
    assert train(*words, "runs=whole").status == 0
    whole = only_run(tmp_path / "whole")
    training_step, steps = PositionModule.training_step, []

    def signalled(self: PositionModule, data: Any, batch_idx: int) -> Any:
        steps.append((self.current_epoch, batch_idx))
        if steps[-1] == (1, batch) and steps.count((1, batch)) == 1:
            os.kill(os.getpid(), signal.Signals[name])
        return training_step(self, data, batch_idx)

    monkeypatch.setattr(PositionModule, "training_step", signalled)
    outcome = train(*words)
    assert outcome.status == status
    assert f"stopped by {name}" in outcome.err
    run = only_run(tmp_path / "runs")
    recorded = run.status()
    assert recorded is not None
    assert (recorded.state, recorded.error) == ("interrupted", f"Stopped: {name}")
    assert [row["epoch"] for row in run.metrics()] == [-1, 0]
    assert train(*words).status == 0
    assert steps == [(epoch, step) for epoch in range(2) for step in range(4)]  # none left out, none repeated
    assert run.metrics() == whole.metrics()
    assert run.results_file.read_bytes() == whole.results_file.read_bytes()
    assert all(torch.equal(weight, weights(whole)[key]) for key, weight in weights(run).items())


def test_a_broken_checkpoint_is_one_line(train: Callable, tmp_path: Path) -> None:
    assert train("logger=none").status == 0
    run = only_run(tmp_path / "runs")
    run.status_file.write_text(run.status_file.read_text().replace("finished", "running"))
    whole = run.last_checkpoint.read_bytes()
    for content in (whole[: len(whole) // 2], b"", b"no checkpoint"):
        run.last_checkpoint.write_bytes(content)
        outcome = train("logger=none")
        assert outcome.status == 1
        assert len(outcome.err.splitlines()) == 1
        assert "last.ckpt: not a whole checkpoint" in outcome.err
    run.last_checkpoint.unlink()
    assert train("logger=none").status == 0


def test_a_loss_that_is_not_finite_stops_the_run_with_the_samples(train: Callable, tmp_path: Path) -> None:
    outcome = train("logger=none", "optimizer.lr=1e30")
    assert outcome.status == 1
    (line,) = [line for line in outcome.err.splitlines() if line.startswith("error: ")]
    assert "loss is " in line
    assert re.search(r"in epoch 1/2, at (train|test) samples 0000\d\d\.png, .* and \d more; the last", line)
    assert "lower optimizer.lr" in line


def test_an_unwritable_runs_folder_is_said_before_anything_is_done(train: Callable, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    outcome = train("logger=none", "runs=file/runs")
    assert outcome.status == 1
    assert "file" in outcome.err
    assert "runs=DIR" in outcome.err
    assert len(outcome.err.splitlines()) == 1


def test_a_sweep_survives_its_failures(train: Callable, tmp_path: Path) -> None:
    outcome = train("-m", "model=mae_vz,probabilistic", "camera=known,constant", "loss=mae", "logger=none")
    assert outcome.status == 2
    assert sum(run.is_finished() for run in find_runs(tmp_path / "runs")) == 2
    lines = [line for line in outcome.err.splitlines() if line.startswith("error: ")]
    assert lines[0] == "error: 2 jobs failed"
    assert "model=probabilistic camera=known" in lines[1]
    assert "model=probabilistic camera=constant" in lines[2]


def test_the_report_computes_what_training_recorded(
    train: Callable, phd_exp: Callable, tmp_path: Path
) -> None:
    assert train("model=probabilistic", "logger=none").status == 0
    (run,) = read_report(tmp_path / "runs").runs
    assert (run.state, run.seed) == ("finished", 0)
    assert run.overrides is not None
    results = run.folder.results()
    for quantity in QUANTITIES:
        mean = run.errors[ErrorKey("mode", "whole", quantity)]
        assert mean.n == 6
        assert mean.value == pytest.approx(results[f"test/{quantity}_error_mm"], rel=1e-4)
    assert run.notes == []
    assert run.nll == pytest.approx(results["test/nll"])
    outcome = phd_exp("report")
    assert outcome.status == 0
    (line,) = [line for line in outcome.out.splitlines() if run.path in line]
    assert f"{results['test/nll']:.2f}" in line.split()
    assert "finished" in line


def test_a_missing_bpy_is_one_line(
    phd_exp: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import importlib.util

    real = importlib.util.find_spec
    monkeypatch.setattr(
        "importlib.util.find_spec", lambda name, *more: None if name == "bpy" else real(name, *more)
    )
    outcome = phd_exp("preset=smoke", "logger=none")
    assert outcome.status == 1
    (line,) = [line for line in outcome.err.splitlines() if line.startswith("error: ")]
    assert "bpy" in line
    assert "phd_exp[render]" in line
    assert not list(tmp_path.rglob("*.png"))
    assert not list(tmp_path.glob("runs"))

"""From the command line to a run record, on real renders; `tests/training/test_run.py` has the laws of one run."""

import json
import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from phd_exp.evaluation.point_errors import ErrorKey
from phd_exp.records.runs import RunFolder
from phd_exp.reports.numbers import command_of
from phd_exp.reports.report import read_report
from phd_exp.training.module import PositionModule
from tests.e2e.conftest import QUICK, QUICKER
from tests.support.recorded import only_run, status_of


def test_a_run_with_pictures_and_wandb_which_repeating_the_command_finds(
    train: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """wandb writes neither to the home folder nor to the environment of the next run."""
    words = ("evaluation.calibration_every_n_epochs=1", "trainer.max_epochs=1")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    before = dict(os.environ)
    outcome = train(*words)
    assert outcome.status == 0, outcome.err
    assert not list((tmp_path / "home").rglob("*wandb*"))
    assert {name for name in os.environ if name.startswith("WANDB_")} - before.keys() == set()
    run = only_run(tmp_path / "runs")
    (offline,) = (run.path / "wandb").glob("offline-run-*")
    assert list(offline.glob("run-*.wandb"))
    assert list(offline.glob("files/media/images/test/calibration*.png"))
    for name in ("epoch-0000", "final"):
        with Image.open(run.calibration / f"{name}.png") as picture:
            assert picture.size[0] > 500
    written = run.results_file.stat().st_mtime_ns
    with monkeypatch.context() as patch:
        patch.delattr(RunFolder, "held")  # the folder of a finished run may be read-only
        again = train(*words)
    assert (again.status, "finished already" in again.out) == (0, True)
    assert run.results_file.stat().st_mtime_ns == written


def in_wandb_viewer(run: RunFolder, *words: str) -> str:
    """Output of wandb's own viewer for the only offline run."""
    (offline,) = (run.path / "wandb").glob("offline-run-*")
    command = [sys.executable, "-m", "wandb", "leet", "inspect", "--json", *words, str(offline)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


@pytest.mark.slow
def test_wandb_ends_as_the_run_ended(train: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One wandb run: failed if the run failed; complete, from the first epoch on, if the run was resumed."""

    def power_cut_in_epoch_1(self: Any) -> None:
        if self.current_epoch == 1:
            raise RuntimeError("power cut")
        self.training_rows.reset()

    with monkeypatch.context() as patch:
        patch.setattr(PositionModule, "on_train_epoch_end", power_cut_in_epoch_1)
        assert train("evaluation.calibration_every_n_epochs=1").status == 1
    run = only_run(tmp_path / "runs")
    assert json.loads(in_wandb_viewer(run, "--summary"))["state"] == "failed"

    assert train("evaluation.calibration_every_n_epochs=1").status == 0
    viewed = json.loads(in_wandb_viewer(run, "--summary"))
    assert viewed["state"] == "finished"
    results = run.results()
    assert {key: viewed["summary"][key] for key in results} == pytest.approx(results)
    assert viewed["config"]["model"]["name"] == "probabilistic"
    records = [json.loads(line) for line in in_wandb_viewer(run).splitlines()]
    items = [record["history"]["item"] for record in records if record["type"] == "history"]
    errors = {item["epoch"]: item["test/depth_error_mm"] for item in items if "test/depth_error_mm" in item}
    assert errors == pytest.approx({row["epoch"]: row["test/depth_error_mm"] for row in run.metrics()})
    pictures = [item for item in items if "test/calibration._type" in item or "test/calibration" in item]
    assert len(pictures) == 3  # of two epochs, and the end


def test_a_signal_ends_the_command_with_its_status(
    train: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(PositionModule, "on_train_batch_start", lambda *_: signal.raise_signal(signal.SIGTERM))
    outcome = train("logger=none", "recipe=strong", "data.image_size=64", "backbone.width=8")
    assert outcome.status == 143
    assert "stopped by SIGTERM" in outcome.err
    run = only_run(tmp_path / "runs")
    assert run.path.relative_to(tmp_path / "runs").as_posix().startswith("smoke+strong/default/")
    assert (status_of(run).state, status_of(run).error) == ("interrupted", "Stopped: SIGTERM")


def test_the_report_computes_what_training_recorded(run: RunFolder, phd_exp: Callable) -> None:
    assert not list(run.path.rglob("*wandb*"))
    runs = run.path.parents[3]
    (read,) = read_report(runs).runs
    assert (read.state, read.seed, read.notes) == ("finished", 0, [])
    assert "trainer.max_epochs=" in (read.overrides or "")
    again = phd_exp(*shlex.split(command_of(read))[3:])
    assert (again.status, "finished already" in again.out) == (0, True)
    results = run.results()
    for quantity in ("projected", "depth"):
        mean = read.errors[ErrorKey("mode", "whole", quantity)]
        assert mean.n == 6
        assert mean.value == pytest.approx(results[f"test/{quantity}_error_mm"], rel=1e-4)
    assert read.nll == pytest.approx(results["test/nll"])
    outcome = phd_exp("report", f"runs={runs}")
    assert outcome.status == 0
    (line,) = [line for line in outcome.out.splitlines() if read.path in line]
    assert f"{results['test/nll']:.2f}" in line.split()
    assert "finished" in line


def test_a_missing_bpy_is_one_line(phd_exp: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import importlib.util

    real = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *more: None if name == "bpy" else real(name, *more))
    outcome = phd_exp("preset=smoke", "logger=none")
    assert outcome.status == 1
    (line,) = [line for line in outcome.err.splitlines() if line.startswith("error: ")]
    assert "bpy" in line
    assert "phd_exp[render]" in line
    assert not list(tmp_path.rglob("*.png"))
    assert not list(tmp_path.glob("runs"))


@pytest.mark.usefixtures("undrawn")
def test_it_begins_where_that_run_ended_with_its_constants_of_depth(
    phd_exp: Callable, run: RunFolder, renders: Path, tmp_path: Path
) -> None:
    """On scenes at other distances, whose own constants are others."""
    words = (*QUICK, *QUICKER, f"data.root={tmp_path / 'far'}", "data.variant=far", "data.z_range=[4,7]")
    few = ("data.n_train=8", "data.n_held_out=0", "data.n_test=2")
    assert phd_exp(*words, *few, f"init={run.path}").status == 0
    mine = only_run(tmp_path / "runs")
    assert mine.constants() == run.constants()
    same = (*QUICK, *QUICKER, f"data.root={renders}", f"init={run.path}", f"runs={tmp_path / 'same'}")
    assert phd_exp(*same).status == 0
    before, after = run.results(), only_run(tmp_path / "same").results()
    assert after["untrained/test/nll"] == pytest.approx(before["test/nll"], rel=1e-5)
    assert after["test/nll"] != before["test/nll"]

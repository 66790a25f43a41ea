"""Runs and how they stand, from records alone."""

import json
from dataclasses import asdict
from pathlib import Path

import pandas as pd
import pytest

from phd_exp.evaluation.point_errors import ErrorKey
from phd_exp.records.choices import RunName
from phd_exp.records.runs import RunFolder
from phd_exp.reports import measured as measured_module
from phd_exp.reports.measured import Measured
from phd_exp.reports.runs import Run, read_report
from tests.support.recorded import predicted, record
from tests.support.synthetic import write_run

DEPTH = ErrorKey("mode", "whole", "depth")


def only(runs: Path) -> Run:
    (run,) = read_report(runs).runs
    return run


def unfinished(runs: Path, error: BaseException) -> RunFolder:
    folder = RunFolder(RunName("small", "occl", "mae_vz", 0).folder(runs))
    folder.path.mkdir(parents=True)
    with pytest.raises(type(error)), folder.recording(data_manifest=None):
        raise error
    return folder


def test_a_finished_run_has_its_errors(tmp_path: Path) -> None:
    record(tmp_path, "occl", "probabilistic", 3, predicted(0).frame)
    run = only(tmp_path)
    assert (run.preset, run.data, run.model, run.seed) == ("small", "occl", "probabilistic", 3)
    assert (run.state, run.overrides, run.detail) == ("finished", None, "")
    assert len(run.errors) == 12
    assert run.nll is not None


def test_a_baseline_has_one_estimate_and_no_nll(tmp_path: Path) -> None:
    record(tmp_path, "occl", "mae_vz", 0, predicted(0, probabilistic=False).frame)
    run = only(tmp_path)
    assert {key.estimate for key in run.errors} == {"mode"}
    assert run.nll is None


def test_a_failed_run_says_why_on_one_line(tmp_path: Path) -> None:
    unfinished(tmp_path, ValueError("odd\nnumber"))
    run = only(tmp_path)
    assert (run.state, run.detail, run.errors) == ("failed", "ValueError: odd number", {})


def test_a_stopped_run_is_interrupted(tmp_path: Path) -> None:
    unfinished(tmp_path, KeyboardInterrupt())
    assert only(tmp_path).state == "interrupted"


def test_a_killed_run_does_not_look_alive(tmp_path: Path) -> None:
    run = RunFolder(RunName("small", "occl", "mae_vz", 0).folder(tmp_path))
    with run.held():
        with run.recording(data_manifest=None):
            status = run.status()
        assert status is not None
        run.write_status(status)  # as a SIGKILL would have left it
        assert only(tmp_path).state == "running"
    assert only(tmp_path).state == "interrupted"


def test_a_lock_that_cannot_be_tried_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = unfinished(tmp_path, ValueError())
    status = folder.status()
    assert status is not None
    folder.write_status(status.model_copy(update={"state": "running"}))

    def read_only(self: RunFolder) -> bool:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(RunFolder, "is_held", read_only)
    run = only(tmp_path)
    assert run.state == "running"
    assert "interrupted" in run.detail
    assert "Permission denied" in run.detail


def test_runs_with_other_overrides_are_apart_and_say_which(tmp_path: Path) -> None:
    plain = record(tmp_path, "occl", "mae_vz", 0, predicted(0).frame)
    other = record(tmp_path, "occl", "mae_vz", 0, predicted(1).frame, overrides=("optimizer.lr=0.5",))
    config = {"seed": 0, "runs": "runs", "optimizer": {"lr": 0.001, "eps": 1}, "backbone": {"depth": 50}}
    plain.write_config(config)
    other.write_config({**config, "runs": "elsewhere", "optimizer": {"lr": 0.5, "eps": 1, "foreach": True}})
    records = read_report(tmp_path)
    assert [run.overrides for run in records.runs] == [None, "optimizer.lr=0.5, optimizer.foreach=True"]
    chosen = records.at_defaults("small", "occl", "mae_vz")
    assert list(chosen) == [0]
    assert chosen[0].folder.path == plain.path


def test_how_a_run_was_computed_sets_it_apart_from_none(tmp_path: Path) -> None:
    """A run with other threads, workers, logger or progress bar stands in its table."""
    shared = {
        "optimizer": {"lr": 0.1},
        "trainer": {"threads": None, "progress_bar": True},
        "logger": {"kind": "wandb"},
    }
    other = {
        "optimizer": {"lr": 0.1},
        "trainer": {"threads": 1, "progress_bar": False},
        "logger": {"kind": "none"},
    }
    record(tmp_path, "occl", "mae_vz", 0, predicted(0).frame).write_config(shared)
    record(tmp_path, "occl", "mae_vz", 1, predicted(1).frame, overrides=("trainer.threads=1",)).write_config(
        other
    )
    assert list(read_report(tmp_path).at_defaults("small", "occl", "mae_vz")) == [1, 0]


def test_of_another_class_the_name_is_told_and_what_both_take(tmp_path: Path) -> None:
    plain = {"_target_": "here.Muon", "lr": 0.1, "momentum": 0.9}
    other = {"_target_": "torch.optim.Adam", "lr": 0.2, "fused": True}
    for overrides, optimizer, often in (((), plain, 1), (("optimizer=adam",), other, 2)):
        run = record(tmp_path, "occl", "mae_vz", 0, predicted(0).frame, overrides=overrides)
        # how often is measured changes no number
        run.write_config({"optimizer": optimizer, "evaluation": {"every_n_epochs": often}})
    assert [run.overrides for run in read_report(tmp_path).runs] == [None, "optimizer=Adam, optimizer.lr=0.2"]


def test_overrides_without_a_run_to_compare_with_are_not_guessed(tmp_path: Path) -> None:
    record(tmp_path, "occl", "mae_vz", 0, predicted(1).frame, overrides=("optimizer.lr=0.5",))
    assert only(tmp_path).overrides == "unknown: there is no run without overrides to compare with"


@pytest.mark.parametrize("leaf", ["seed", "seedx", "seed00", "seed1-xyz", "seed-1"])
def test_a_folder_that_no_run_is_given_stays_out_of_the_tables(tmp_path: Path, leaf: str) -> None:
    folder = record(tmp_path, "occl", "mae_vz", 0, predicted(0).frame)
    folder.path.rename(folder.path.with_name(leaf))
    assert only(tmp_path).state == "unreadable"
    assert read_report(tmp_path).at_defaults("small", "occl", "mae_vz") == {}


def test_no_runs_are_no_error(tmp_path: Path) -> None:
    assert read_report(tmp_path).runs == ()


def test_a_run_is_measured_again_where_it_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs, kept = tmp_path / "runs", tmp_path / "kept"
    for data in ("default", "occl"):
        write_run(runs, data, n=40, epochs=2)
    measured: list[str] = []
    real = measured_module.measure

    def counted(folder: RunFolder, config: dict[str, str]) -> Measured:
        measured.append(folder.path.parent.parent.name)
        return real(folder, config)

    monkeypatch.setattr(measured_module, "measure", counted)
    first = read_report(runs, kept)
    predictions = first.runs[1].folder.predictions
    again = read_report(runs, kept)
    assert measured == ["default", "occl"]
    texts = [[json.dumps(asdict(run.measured)) for run in report.runs] for report in (first, again)]
    assert texts[0] == texts[1]
    pd.read_parquet(predictions).iloc[1:].to_parquet(predictions)
    (kept / "small-default-probabilistic-seed0.json").write_text("{")
    assert [run.measured.before.n for run in read_report(runs, kept).runs if run.measured.before] == [40, 39]
    assert measured == ["default", "occl"] * 2

"""Runs and their states, from records alone."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from phd_exp.evaluation.point_errors import ErrorKey
from phd_exp.records.choices import RunName
from phd_exp.records.runs import RunFolder
from phd_exp.reports import runs as runs_module
from phd_exp.reports.measured import Measured, measure
from phd_exp.reports.report import read_report
from phd_exp.reports.runs import Run
from tests.support.recorded import predicted, record, status_of
from tests.support.synthetic import write_run

DEPTH = ErrorKey("mode", "whole", "depth")


def only(runs: Path) -> Run:
    (run,) = read_report(runs).runs
    return run


def test_a_finished_run_has_its_errors(tmp_path: Path) -> None:
    record(tmp_path, "occl", "probabilistic", 3, predicted(0).frame)
    record(tmp_path, "scale", "mae_vz", 0, predicted(0, probabilistic=False).frame)
    run, baseline = read_report(tmp_path).runs
    assert (run.preset, run.data, run.model, run.seed) == ("small", "occl", "probabilistic", 3)
    assert (run.state, run.overrides, run.detail, len(run.errors)) == ("finished", None, "", 12)
    assert run.nll is not None
    assert {key.estimate for key in baseline.errors} == {"mode"}
    assert baseline.nll is None


def test_a_killed_run_does_not_look_alive(tmp_path: Path) -> None:
    run = RunFolder(RunName("small", "occl", "mae_vz", 0).folder(tmp_path))
    with run.held():
        with run.recording(data_manifest=None):
            status = status_of(run)
        run.write_status(status)  # as a SIGKILL would have left it
        assert only(tmp_path).state == "running"
    assert only(tmp_path).state == "interrupted"


def test_a_lock_that_cannot_be_tried_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    status_of(record(tmp_path, "occl", "mae_vz"), state="running")

    def read_only(self: RunFolder) -> bool:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(RunFolder, "is_held", read_only)
    run = only(tmp_path)
    assert run.state == "running"
    assert "interrupted" in run.detail
    assert "Permission denied" in run.detail


def test_runs_with_other_overrides_are_apart_and_say_which(tmp_path: Path) -> None:
    words = ("optimizer.lr=0.5", "+optimizer.foreach=true", "logger=none")
    other = record(tmp_path, "occl", "mae_vz", 0, predicted(1).frame, overrides=words)
    plain = record(tmp_path, "occl", "mae_vz", 0, predicted(0).frame)
    records = read_report(tmp_path)
    assert [run.overrides for run in records.runs] == [None, "optimizer.lr=0.5 +optimizer.foreach=true"]
    status_of(other, overrides=[])
    status_of(plain, overrides=["trainer.threads=1", "logger=none"])  # settings of the computation
    overrides = [run.overrides for run in read_report(tmp_path).runs]
    assert overrides == [None, other.path.name.removeprefix("seed0-")]


@pytest.mark.parametrize("leaf", ["seed", "seedx", "seed00", "seed1-xyz", "seed-1"])
def test_a_folder_with_another_name_enters_no_table(tmp_path: Path, leaf: str) -> None:
    folder = record(tmp_path, "occl", "mae_vz", 0, predicted(0).frame)
    folder.path.rename(folder.path.with_name(leaf))
    assert only(tmp_path).state == "unreadable"
    assert read_report(tmp_path).means.empty


def test_a_run_is_measured_again_where_it_has_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runs, kept = tmp_path / "runs", tmp_path / "kept"
    for data in ("default", "occl"):
        write_run(runs, data, "mae_vz", n=40, epochs=2)
    measured: list[str] = []

    def counted(folder: RunFolder, *rest: Any) -> Measured:
        measured.append(folder.path.parent.parent.name)
        return measure(folder, *rest)

    monkeypatch.setattr(runs_module, "measure", counted)
    first = read_report(runs, kept)
    predictions = first.runs[1].folder.predictions
    again = read_report(runs, kept)
    assert measured == ["default", "occl"]
    texts = [[json.dumps(asdict(run.measured)) for run in report.runs] for report in (first, again)]
    assert texts[0] == texts[1]
    pd.read_parquet(predictions).iloc[1:].to_parquet(predictions)
    (kept / "small-default-mae_vz-seed0.json").write_text("{")
    assert [run.measured.before.n for run in read_report(runs, kept).runs if run.measured.before] == [40, 39]
    assert measured == ["default", "occl"] * 2

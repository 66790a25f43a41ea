"""Run records: named by choices, whole or absent, honest about how a run ended."""

import json
import math
from pathlib import Path

import pytest

from phd_exp.records.choices import RunName
from phd_exp.records.errors import RunError
from phd_exp.records.runs import RunFolder, find_runs

NO_STATUS = ("", "{", "[]", '{"state": "done"}', "\x00")


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    run = RunFolder(RunName("smoke", "occl", "mae_vz", 0).folder(tmp_path))
    run.path.mkdir(parents=True)
    return run


def test_a_run_is_named_by_its_choices(tmp_path: Path) -> None:
    plain = RunName("paper", "scale", "mae_logz", 3).folder(tmp_path)
    assert plain.relative_to(tmp_path).as_posix() == "paper/scale/mae_logz/seed3"
    overrides = (("n=256", "lr=0.1"), ("lr=0.1", "n=256"), ("lr=0.2", "n=256"))
    one, same, other = (RunName("paper", "scale", "mae_logz", 3, words).folder(tmp_path) for words in overrides)
    assert one == same != other
    assert one.name.startswith("seed3-")


def test_a_run_that_ends_well_is_finished(folder: RunFolder) -> None:
    with folder.recording(data_manifest="abc"):
        status = folder.status()
        assert status.state == "running"
        assert not folder.is_finished()
    assert folder.is_finished()
    status = folder.status()
    assert status.data_manifest == "abc"
    assert {"python", "torch", "lightning"} <= status.versions.keys()


@pytest.mark.parametrize(
    ("stop", "state"),
    [(ValueError("no\nuse"), "failed"), (KeyboardInterrupt(), "interrupted"), (SystemExit(), "interrupted")],
)
def test_a_run_that_is_stopped_says_so(folder: RunFolder, stop: BaseException, state: str) -> None:
    with pytest.raises(type(stop)), folder.recording(data_manifest=None):
        raise stop
    status = folder.status()
    assert status.state == state
    assert not folder.is_finished()
    if state == "failed":
        assert "test_runs.py" in status.traceback


def test_two_processes_cannot_hold_one_run(folder: RunFolder) -> None:
    for _ in range(2):  # the lock is released at the end
        with folder.held():
            assert folder.is_held()
            with pytest.raises(RunError, match="another process is working"), RunFolder(folder.path).held():
                pass
        assert not folder.is_held()


def test_an_unwritable_run_folder_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    run = RunFolder(tmp_path / "file" / "run")
    with pytest.raises(RunError, match=r"cannot be written .*runs=DIR"), run.held():
        pass


@pytest.mark.parametrize(
    ("read", "content", "said"),
    [
        *(("status", content, r"status\.json: not a run status .*delete the folder") for content in NO_STATUS),
        ("results", "{", "results.json: cannot be read"),
        ("results", "[1]", "results.json: cannot be read .a list; expected a mapping"),
        ("results", None, r"results\.json: cannot be read .No such file"),
    ],
)
def test_a_broken_record_is_named(folder: RunFolder, read: str, content: str | None, said: str) -> None:
    if content is not None:
        (folder.path / f"{read}.json").write_text(content)
    with pytest.raises(RunError, match=said):
        getattr(folder, read)()


def test_config_and_results_come_back(folder: RunFolder) -> None:
    folder.write_config({"seed": 0, "data": {"n_train": 3}})
    folder.write_results({"test/nll": -1.5, "test/calibration/depth_ence": math.nan, "epochs": 3})
    assert folder.config() == {"seed": 0, "data": {"n_train": 3}}
    written = {"test/nll": -1.5, "test/calibration/depth_ence": None, "epochs": 3}
    assert folder.results() == json.loads(folder.results_file.read_text()) == written
    assert "NaN" not in folder.results_file.read_text(), "JSON knows no such number"


def test_finds_all_runs(tmp_path: Path) -> None:
    for name in (RunName("smoke", "occl", "mae_vz", 1), RunName("paper", "default", "mae_vz", 0, ("a=1",))):
        run = RunFolder(name.folder(tmp_path))
        run.path.mkdir(parents=True)
        with run.recording(data_manifest=None):
            pass
    (tmp_path / "stray").mkdir()
    assert [run.path.name[:5] for run in find_runs(tmp_path)] == ["seed0", "seed1"]

"""Run records: named by choices, whole or absent, honest about how a run ended."""

import json
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

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
    assert (status.state, folder.state()[0], folder.is_finished()) == (state, state, False)
    assert state != "failed" or "test_runs.py" in status.traceback


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


keys, leaves = st.text("abc/._", min_size=1), st.none() | st.booleans() | st.integers() | st.text() | st.floats()
configs = st.dictionaries(keys, st.recursive(leaves, lambda inner: st.lists(inner) | st.dictionaries(keys, inner)))
numbers = st.dictionaries(keys, st.none() | st.integers(-(10**9), 10**9) | st.floats())


def finite(row: dict[str, Any]) -> dict[str, Any]:
    """JSON has no other numbers."""
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in row.items()
    }


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(config=configs, row=numbers)
def test_what_is_recorded_comes_back(folder: RunFolder, config: dict[str, Any], row: dict[str, Any]) -> None:
    folder.write_config(config)
    assert repr(folder.config()) == repr(config)
    folder.write_results(row)
    assert folder.results() == json.loads(folder.results_file.read_text()) == finite(row)
    rows = [{"epoch": epoch, **finite(row)} for epoch in (-1, 0, 1)]
    folder.write_metrics(rows)
    assert folder.metrics() == rows


def test_finds_all_runs(tmp_path: Path) -> None:
    for name in (RunName("smoke", "occl", "mae_vz", 1), RunName("paper", "default", "mae_vz", 0, ("a=1",))):
        run = RunFolder(name.folder(tmp_path))
        run.path.mkdir(parents=True)
        with run.recording(data_manifest=None):
            pass
    (tmp_path / "stray").mkdir()
    assert [run.path.name[:5] for run in find_runs(tmp_path)] == ["seed0", "seed1"]

"""Whatever a run or a search holds, all others are shown, and what is missing is named."""

import json
import math
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, NoReturn

import pandas as pd
import pytest

from phd_exp.records.runs import RunFolder, find_runs
from phd_exp.reports import ensembles, paper_figures, report, runs
from phd_exp.reports.measured import Measured
from phd_exp.reports.runs import Run
from tests.support.recorded import only_run, status_of
from tests.support.synthetic import write_run


def spring(*arguments: Any) -> NoReturn:
    raise ZeroDivisionError("sprung")


USES = (
    "bool", "len", "iter", "str", "eq", "hash", "lt", "gt", "add", "float", "getitem", "contains", "format", "call",
    "getattr", "fspath", "truediv",
)  # fmt: skip
Trap = type("Trap", (), {f"__{use}__": spring for use in USES})
"""Raises whatever is done with it."""


@pytest.fixture
def shown(phd_exp: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], str]:
    """Reports `runs/`, unmeasured, and requires the good run and a page for all; returns standard error."""
    monkeypatch.setattr(runs, "measure", lambda *arguments: Measured())
    write_run(tmp_path / "runs", "default", n=20, epochs=2)
    status_of(only_run(tmp_path / "runs"), machine="\x1b[2J", git_commit="\u202e")

    def written() -> str:
        outcome = phd_exp("report")
        assert outcome.status == 0, outcome.err
        assert "small/default/probabilistic/seed0" in outcome.out
        assert ",default,probabilistic,0," in (tmp_path / "report/tables/runs.csv").read_text()
        assert 'class="note error"' not in page("default")
        tables = [file.read_text() for file in (tmp_path / "report/tables").iterdir()]
        assert not {"\x1b", "\u202e"} & set("".join([outcome.out, outcome.err, *tables]))
        overview = (tmp_path / "report/site/index.html").read_text()
        for folder in find_runs(tmp_path / "runs"):
            assert f'href="runs/small-{folder.path.parts[-3]}-probabilistic-seed0.html"' in overview
            assert page(folder.path.parts[-3])
        return outcome.err

    return written


def page(data: str) -> str:
    return Path(f"report/site/runs/small-{data}-probabilistic-seed0.html").read_text()


FIELDS = [one.name for one in fields(Run) if one.name not in ("folder", "preset", "data", "model", "name", "notes")]
"""All fields that a record fills, except the place of a run, and the notes, which the report makes."""


def test_a_run_of_which_any_field_raises(shown: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole_run = runs._whole_run

    def trapped(run: Run, *arguments: Any) -> Run:
        found = whole_run(run, *arguments)
        return replace(found, **{run.data: Trap()}) if run.data in FIELDS else found

    for name in FIELDS:
        write_run(tmp_path / "runs", name, n=4, epochs=1)
    monkeypatch.setattr(runs, "_whole_run", trapped)
    assert shown() == ""
    assert [name for name in FIELDS if "ZeroDivisionError: sprung" not in page(name)] == []


READ = ("status", "config", "metrics", "results", "predictions", "held_out", "views", "shifts", "eight_views")
"""What the report asks of a finished run's folder."""


def test_a_folder_of_which_any_accessor_raises(
    shown: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [name for name in dir(RunFolder(tmp_path)) if not name.startswith("_")]
    names = [name for name in names if name != "path" and not isinstance(getattr(RunFolder, name, None), property)]
    for name in names:
        write_run(tmp_path / "runs", name, n=4, epochs=1)

    def found(folder: Path) -> list[RunFolder]:
        folders = find_runs(folder)
        for one in folders:
            if one.path.parts[-3] in names:
                setattr(one, one.path.parts[-3], Trap())
        return folders

    monkeypatch.setattr(report, "find_runs", found)
    assert shown() == ""
    assert [name for name in READ if "ZeroDivisionError: sprung" not in page(name)] == []


@pytest.mark.parametrize(
    "started", ["0001-01-01T00:00:00+14:00", "9999-12-31T23:59:59-14:00", "2026-11-26T10:00:00Z"]
)
def test_any_date_is_shown(shown: Callable, tmp_path: Path, started: str) -> None:
    file = write_run(tmp_path / "runs", "odd", n=4, epochs=1).status_file
    file.write_text(json.dumps(json.loads(file.read_text()) | {"started": started, "ended": started}))
    assert shown() == ""
    assert 'class="note error"' not in page("odd")
    assert f" {started[19:].replace('Z', 'UTC')}" in page("odd")


def half(file: Path) -> None:
    content = file.read_bytes()
    file.write_bytes(content[: content.index(b"\n", len(content) // 2) + 1])


def test_half_a_file_leaves_a_note(shown: Callable, tmp_path: Path) -> None:
    half(write_run(tmp_path / "runs", "config", n=4, epochs=1).config_file)
    cut = write_run(tmp_path / "runs", "metrics", n=4, epochs=6)
    cut.write_results(cut.results() | {"epochs": 6})
    assert shown() == ""
    assert 'class="note error"' not in page("metrics")
    half(cut.metrics_file)
    assert "note" not in shown()
    assert "config.yaml: incomplete, without " in page("config")
    assert "metrics.jsonl: incomplete, with " in page("metrics")


def search(folder: Path, name: str, objective: str = "held_out/nll", value: Any = -1.5, number: int = 0) -> None:
    trial = {"number": number, "state": "finished", "overrides": {"optimizer.lr": "0.1"}, "run": "x", "value": value}
    content = {"name": name, "objective": objective, "trials": [trial], "importances": {"optimizer.lr": 1.0}}
    (folder / name).mkdir(parents=True)
    (folder / name / "search.json").write_text(json.dumps(content))


@pytest.mark.parametrize(
    "odd",
    [
        {"objective": "[/b]"}, {"objective": "[red]a[/red]\x1b[2J\n"}, {"value": 1.7976931348623157e308},
        {"value": 10**308}, {"value": 10**400}, {"number": 10**308}, {"number": 10**400}, {"number": -1},
        {"value": None},
    ],
    ids=lambda odd: str(odd)[:40],
)  # fmt: skip
def test_any_search_leaves_all_others(shown: Callable, tmp_path: Path, capfd: Any, odd: dict[str, Any]) -> None:
    folder = tmp_path / "runs" / ".search"
    search(folder, "good")
    search(folder, "odd", **odd)
    err = shown()
    assert "search,trial" in (tables := (tmp_path / "report/tables/searches.csv").read_text())
    assert "good,1,finished,-1.5" in tables
    assert len(err.splitlines()) <= 1
    assert ("odd," in tables) == (err == ""), err


@pytest.mark.parametrize(
    ("module", "name", "note"),
    [
        (ensembles, "_scores", "note: ensembles of small/default/probabilistic/: ZeroDivisionError: sprung"),
        (paper_figures, "_precision", "note: figure precision-small: ZeroDivisionError: sprung"),
    ],
)
def test_a_table_or_figure_that_cannot_be_made_is_named(
    shown: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: Any, name: str, note: str
) -> None:
    """The run itself is not at fault: it is shown."""
    write_run(tmp_path / "runs", "default", seed=1, n=20)
    made = getattr(module, name)
    monkeypatch.setattr(module, name, lambda found: made(found) if len(found) == 1 else spring())
    assert note in shown()


AS_THE_OTHERS = [pytest.param(number, marks=pytest.mark.slow) for number in (math.inf, -1e308, 1e-308)]


@pytest.mark.filterwarnings("always")
@pytest.mark.parametrize("number", [math.nan, 1e308, *AS_THE_OTHERS])
def test_no_number_warns(phd_exp: Callable, tmp_path: Path, recwarn: pytest.WarningsRecorder, number: float) -> None:
    for name in ("mode_x", "z", "f", "nll"):
        run = write_run(tmp_path / "runs", name, n=3, epochs=1)
        pd.read_parquet(run.predictions).assign(**{name: number}).to_parquet(run.predictions)
        run.write_metrics([row | {f"test/{name}": None, "test/nll": 1e308} for row in run.metrics()])
    outcome = phd_exp("report")
    assert (outcome.status, outcome.err) == (0, "")
    assert [str(one.message) for one in recwarn] == []

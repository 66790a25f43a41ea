"""Whatever the record of a run contains, its page says what is wrong and all other runs are unaffected."""

import html
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from phd_exp.records.runs import SECTIONS, RunFolder
from phd_exp.reports.table import file_stem
from tests.bad_input.images import pipe
from tests.support.recorded import reported, sited
from tests.support.synthetic import write_run

Spoil = Callable[[RunFolder], object]


def column(**values: object) -> Spoil:
    """Replace columns of the predictions."""
    return lambda run: pd.read_parquet(run.predictions).assign(**values).to_parquet(run.predictions)


def rows(chosen: Callable[[pd.DataFrame], pd.DataFrame]) -> Spoil:
    def spoil(run: RunFolder) -> None:
        for file in filter(Path.exists, (run.predictions, run.held_out)):
            chosen(pd.read_parquet(file)).to_parquet(file)

    return spoil


def files(**contents: bytes | str) -> Spoil:
    """Replace files of the run, named without their suffix."""

    def spoil(run: RunFolder) -> None:
        known = (run.predictions, run.held_out, run.views, run.status_file, run.metrics_file, run.config_file)
        for file in known:
            if file.stem in contents:
                content = contents[file.stem]
                file.write_bytes(content.encode() if isinstance(content, str) else content)

    return spoil


def bad_status(spoil: Spoil) -> Spoil:
    """Spoil the status; the predictions are torn too, for there is nothing to learn from their measurement."""
    return lambda run: (run.predictions.write_bytes(b"PAR1"), spoil(run))


RENAMED: dict[str, bytes | str] = {
    "mathematics in a name": "$x_$",
    "no UTF-8 in a name": b"d\xff\xfe",
    "a name of 250 characters": "d" * 250,
    "a name of another script": "数据 é",
}


def renamed(name: str) -> Spoil:
    """Rename the data set's folder."""

    def spoil(run: RunFolder) -> None:
        folder = run.path.parents[1]
        os.rename(os.fsencode(folder), os.path.join(os.fsencode(folder.parent), os.fsencode(RENAMED[name])))

    return spoil


HARMLESS: dict[str, Spoil] = {
    "all rows equal": rows(lambda frame: frame.loc[[0] * 50].reset_index(drop=True)),
    "mathematics in a name": renamed("mathematics in a name"),
}
"""Unusual, and shown like any other run."""
LONG: dict[str, Spoil] = {
    "two test samples": rows(lambda frame: frame.head(2)),
    "one variance of zero": rows(
        lambda frame: frame.assign(depth_variance=frame["depth_variance"].where(frame.index > 0, 0.0))
    ),
    "a config with a lone surrogate": files(config="".join(f'{name}: {{x: "\\ud800"}}\n' for name in SECTIONS)),
    "long texts": column(file_name="x" * 100_000),
    **{name: renamed(name) for name in RENAMED if name not in HARMLESS},
}
"""The same in a second, slow report."""
BROKEN: dict[str, tuple[Spoil, tuple[str, ...]]] = {
    "four broken files": (
        files(held_out=b"PAR1", views=b"PAR1", metrics=b'{"epoch": 0, "a": 1e999}\n[]\n', config="[" * 5000),
        ("held_out.parquet: cannot be read", "views.parquet: cannot be read", "metrics.jsonl", "config.yaml"),
    ),
    "a number of 90k digits": (files(config="a: " + "9" * 90_000, predictions=b"PAR1"), ("config.yaml",)),
    "one test sample": (rows(lambda frame: frame.head(1)), ("one test sample; expected at least two",)),
    "nothing finite": (column(a=np.nan, nll=np.nan), ("none of 3 samples has finite",)),
    "a precision below zero": (column(a=-1.0), ("no distribution",)),
    "integers of 2^63-1": (column(**dict.fromkeys("xyz", 2**63 - 1), mode_x=2**63 - 1), ()),
    "numbers that overflow": (column(mean_x=1e300, depth_squared_error=1e300), ("mean error is not finite",)),
    "negative squares": (column(depth_squared_error=-1.0), ()),
    "text for numbers": (column(mode_x="left"), ("parquet: cannot be read (column 'mode_x' holds ",)),
    "lists for numbers": (column(nll=[[1.0]] * 3), ("(column 'nll' holds list<",)),
    "no columns": (rows(lambda frame: frame[["x"]]), ("no column", "as in older records")),
    "no table": (files(predictions=b"PAR1"), ("predictions.parquet: cannot be read (",)),
    "predictions gone": (lambda run: run.predictions.unlink(), ("missing, though the run has finished",)),
    "a pipe of predictions": (lambda run: pipe(run.predictions), ("cannot be read (a pipe or a device",)),
    "no status": (bad_status(files(status=b"{")), ("status.json: not a run status",)),
    "a pipe of a status": (bad_status(lambda run: pipe(run.status_file)), ("not a run status (a pipe or a device",)),
}
"""Lines that the page must contain; empty if the run may be measured all the same."""
GOOD = "good"
DEFAULT: dict[str, Spoil] = HARMLESS | {name: spoil for name, (spoil, _) in BROKEN.items()}


def spoiled(folder: Path, spoils: dict[str, Spoil]) -> Path:
    """A good run and its spoiled copies."""
    good = write_run(folder / "runs", GOOD, n=50, epochs=2)
    write_run(folder / "elsewhere", GOOD, seed=1, n=50).predictions.rename(good.held_out)
    for number, (name, spoil) in enumerate(spoils.items()):
        copy = folder / "runs" / "small" / f"data{number}" / "probabilistic" / "seed0"
        shutil.copytree(good.path, copy)
        # fewer strata and pictures: seconds per run
        rows(lambda frame: frame.drop(columns=["visibility", "truncation"]).head(3))(RunFolder(copy))
        if name in BROKEN:
            RunFolder(copy).held_out.unlink()  # no recalibration
        spoil(RunFolder(copy))
    return folder / "runs"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hostile")
    return sited(spoiled(folder, DEFAULT), folder / "report")


@pytest.fixture(scope="module")
def long_site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """By the command itself, so with figures, of the broken runs too."""
    folder = tmp_path_factory.mktemp("odd")
    reported(spoiled(folder, LONG | DEFAULT), folder / "report")
    return folder / "report" / "site"


def page_of(site: Path, name: str, spoils: dict[str, Spoil]) -> str:
    data = os.fsdecode(RENAMED.get(name, f"data{list(spoils).index(name)}"))
    return html.unescape((site / "runs" / f"{file_stem('small', data, 'probabilistic', 'seed0')}.html").read_text())


def require_shown(page: str) -> None:
    assert 'class="note error"' not in page, page[page.index('class="note error"') :][:300]
    assert 'id="numbers"' in page


@pytest.mark.parametrize("name", HARMLESS)
def test_an_unusual_run_is_shown_like_any_other(site: Path, name: str) -> None:
    require_shown(page_of(site, name, DEFAULT))


@pytest.mark.slow
@pytest.mark.parametrize("name", LONG)
def test_further_unusual_runs_are_shown_like_any_other(long_site: Path, name: str) -> None:
    require_shown(page_of(long_site, name, LONG | DEFAULT))


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_run_has_the_reason_on_its_page(site: Path, name: str) -> None:
    page = page_of(site, name, DEFAULT)
    assert [line for line in BROKEN[name][1] if line not in page] == []


def test_all_other_runs_are_complete(site: Path) -> None:
    page = (site / "runs" / f"small-{GOOD}-probabilistic-seed0.html").read_text()
    assert 'class="note error"' not in page
    assert all(f'id="{name}"' in page for name in ("gallery", "calibration", "learning", "strata", "numbers"))
    assert len(list((site / "runs").iterdir())) == 1 + len(DEFAULT)
    for file in (site / "data").iterdir():
        script = file.read_text()
        # NaN and infinity are not JSON
        json.loads(script[script.index(", ") + 2 : -3], parse_constant=pytest.fail)

"""Whatever the record of a run holds: its page says what is wrong, and all other runs are whole."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from phd_exp.evaluation.parquet import read_table
from phd_exp.records.errors import RunError
from phd_exp.records.runs import RunFolder
from phd_exp.reports.table import file_stem
from tests.support.recorded import once, reported
from tests.support.synthetic import write_run

Spoil = Callable[[RunFolder], None]


def column(**values: object) -> Spoil:
    """Replace columns of the predictions."""

    def spoil(run: RunFolder) -> None:
        pd.read_parquet(run.predictions).assign(**values).to_parquet(run.predictions)

    return spoil


def rows(chosen: Callable[[pd.DataFrame], pd.DataFrame]) -> Spoil:
    def spoil(run: RunFolder) -> None:
        for file in (run.predictions, run.held_out):
            chosen(pd.read_parquet(file)).to_parquet(file)

    return spoil


def text(name: str, content: bytes) -> Spoil:
    return lambda run: (run.path / name).write_bytes(content) and None  # type: ignore[return-value]


def config(content: str) -> Spoil:
    return lambda run: run.config_file.write_text(content) and None  # type: ignore[return-value]


RENAMED: dict[str, bytes | str] = {
    "mathematics in a name": "$x_$",
    "no UTF-8 in a name": b"d\xff\xfe",
    "a name of 250 characters": "d" * 250,
    "a name of another script": "数据 é",
}


def renamed(name: str) -> Spoil:
    """Give the data set's folder another name."""

    def spoil(run: RunFolder) -> None:
        folder = run.path.parents[1]
        os.rename(os.fsencode(folder), os.path.join(os.fsencode(folder.parent), os.fsencode(RENAMED[name])))

    return spoil


def one_zero(frame: pd.DataFrame) -> pd.DataFrame:
    frame.loc[0, "depth_variance"] = 0.0
    return frame


HARMLESS: dict[str, Spoil] = {
    "one test sample": rows(lambda frame: frame.head(1)),
    "two test samples": rows(lambda frame: frame.head(2)),
    "one variance of zero": rows(one_zero),
    "all rows equal": rows(lambda frame: frame.loc[[0] * 50].reset_index(drop=True)),
    "mathematics in a name": renamed("mathematics in a name"),
    "no UTF-8 in a name": renamed("no UTF-8 in a name"),
    "a name of 250 characters": renamed("a name of 250 characters"),
    "a name of another script": renamed("a name of another script"),
    "a config with a lone surrogate": config('a: "\\ud800"\ndata: {root: "\\ud800", spec: {variant: x}}\n'),
    "long texts": column(file_name="x" * 100_000),
}
"""Odd, and shown like any other run."""
BROKEN: dict[str, tuple[Spoil, str]] = {
    "a number of 900k digits": (config("a: " + "9" * 900_000), "config.yaml"),
    "a hexadecimal number of 900k digits": (config("a: 0x" + "f" * 900_000), "digits"),
    "nothing finite": (column(a=np.nan, nll=np.nan), "none of 50 samples has finite"),
    "a precision below zero": (column(a=-1.0), "no distribution"),
    "a depth below zero": (column(z=-1.0), "column z is not finite everywhere, or not positive"),
    "integers of 2^63-1": (column(**dict.fromkeys("xyz", 2**63 - 1), mode_x=2**63 - 1), ""),
    "numbers that overflow": (column(mean_x=1e300, depth_squared_error=1e300), "mean error is not finite"),
    "negative squares": (column(depth_squared_error=-1.0), ""),
    "text for numbers": (column(mu_x="far left"), "mu_x"),
    "no rows": (rows(lambda frame: frame.head(0)), "has no rows"),
    "no columns": (rows(lambda frame: frame[["x"]]), "no column"),
    "no table": (text("predictions.parquet", b"PAR1"), "cannot be read"),
    "no held-out table": (text("held_out.parquet", b"PAR1"), "held_out.parquet: cannot be read"),
    "no several views": (text("views.parquet", b"PAR1"), "views.parquet: cannot be read"),
    "no status": (text("status.json", b"{"), "status.json"),
    "a status of bytes": (text("status.json", b"\xff\x00"), "status.json"),
    "metrics that are none": (text("metrics.jsonl", b'{"epoch": 0, "a": 1e999}\n[]\n'), "metrics.jsonl"),
    "a deep config": (config("[" * 5000), "config.yaml"),
    "a folder for a file": (lambda run: (run.metrics_file.unlink(), run.metrics_file.mkdir()), "directory"),  # type: ignore[dict-item]
}  # fmt: skip
"""What must be said on the page, in one line; empty where it may be measured all the same."""


GOOD = "good"
ALL: dict[str, Spoil] = HARMLESS | {name: spoil for name, (spoil, _) in BROKEN.items()}
LONG = [
    name for name in HARMLESS if name not in ("one test sample", "all rows equal", "mathematics in a name")
]
"""Runs that are measured completely, which takes seconds each; a separate, slow report."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One report of a good run and the others."""
    names = [name for name in ALL if name not in LONG]
    return once(tmp_path_factory, "hostile_runs", lambda folder: _report(folder, names)) / "report" / "site"


@pytest.fixture(scope="module")
def long_site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return once(tmp_path_factory, "odd_runs", lambda folder: _report(folder, LONG)) / "report" / "site"


def _report(folder: Path, names: list[str]) -> None:
    runs = folder / "runs"
    good = write_run(runs, GOOD, n=50, epochs=2)
    write_run(folder / "elsewhere", GOOD, seed=1, n=50).predictions.rename(good.held_out)
    for name in names:
        copy = runs / "small" / data_of(name) / "probabilistic" / "seed0"
        shutil.copytree(good.path, copy)
        ALL[name](RunFolder(copy))
    reported(runs, folder / "report")


def data_of(name: str) -> str:
    return f"data{list(ALL).index(name)}"


def page_of(site: Path, name: str) -> str:
    data = os.fsdecode(RENAMED.get(name, data_of(name)))
    return (site / "runs" / f"{file_stem('small', data, 'probabilistic', 'seed0')}.html").read_text()


@pytest.mark.parametrize("name", [name for name in HARMLESS if name not in LONG])
def test_what_is_only_odd_is_shown_like_any_other(site: Path, name: str) -> None:
    require_shown(page_of(site, name))


@pytest.mark.slow
@pytest.mark.parametrize("name", LONG)
def test_whatever_is_only_odd_is_shown_like_any_other(long_site: Path, name: str) -> None:
    require_shown(page_of(long_site, name))


def require_shown(page: str) -> None:
    assert 'class="note error"' not in page, page[page.index('class="note error"') :][:300]
    assert 'id="numbers"' in page


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_broken_says_so_on_its_page(site: Path, name: str) -> None:
    said = BROKEN[name][1]
    assert said in page_of(site, name)


def test_all_others_are_whole(site: Path) -> None:
    page = (site / "runs" / f"small-{GOOD}-probabilistic-seed0.html").read_text()
    assert 'class="note error"' not in page
    assert all(f'id="{name}"' in page for name in ("gallery", "calibration", "learning", "strata", "numbers"))
    assert len(list((site / "runs").iterdir())) == 1 + len(ALL) - len(LONG)
    for file in (site / "data").iterdir():
        script = file.read_text()
        # NaN and infinity are not JSON
        json.loads(script[script.index(", ") + 2 : -3], parse_constant=pytest.fail)


def test_rows_are_bounded_before_they_are_read(tmp_path: Path) -> None:
    """900,000 equal rows are 121 kB on the disk."""
    names = [f"c{index}" for index in range(30)]
    table = pa.table({name: pa.array(np.zeros(900_000)) for name in names})
    pq.write_table(table, tmp_path / "predictions.parquet", compression="zstd")
    assert (tmp_path / "predictions.parquet").stat().st_size < 200_000
    with pytest.raises(RunError, match=r"has 900000 rows of 30 columns.*expected at most"):
        read_table(tmp_path / "predictions.parquet")

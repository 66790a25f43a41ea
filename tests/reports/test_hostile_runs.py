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

from phd_exp.cli import report
from phd_exp.evaluation.parquet import read_table
from phd_exp.records.errors import RunError
from phd_exp.records.runs import RunFolder
from tests.reports.site.synthetic import write_run

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


def renamed(name: bytes | str) -> Spoil:
    """Give the data set's folder another name."""

    def spoil(run: RunFolder) -> None:
        folder = run.path.parents[1]
        os.rename(os.fsencode(folder), os.path.join(os.fsencode(folder.parent), os.fsencode(name)))

    return spoil


def one_zero(frame: pd.DataFrame) -> pd.DataFrame:
    frame.loc[0, "depth_variance"] = 0.0
    return frame


HARMLESS: dict[str, Spoil] = {
    "one test sample": rows(lambda frame: frame.head(1)),
    "two test samples": rows(lambda frame: frame.head(2)),
    "one variance of zero": rows(one_zero),
    "all rows equal": rows(lambda frame: frame.loc[[0] * 50].reset_index(drop=True)),
    "mathematics in a name": renamed("$x_$"),
    "no UTF-8 in a name": renamed(b"d\xff\xfe"),
    "a name of 250 characters": renamed("d" * 250),
    "a name of another script": renamed("数据 é"),
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


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs, one of them to be spoiled."""
    runs = tmp_path_factory.mktemp("whole") / "runs"
    run = write_run(runs, "occl", n=50, epochs=2)
    write_run(runs.parent / "elsewhere", "occl", seed=1, n=50).predictions.rename(run.held_out)
    write_run(runs, "scale", "mae_vz", n=50, epochs=2)
    return runs


@pytest.mark.parametrize("name", [*HARMLESS, *BROKEN])
def test_a_run_spoils_no_report(
    whole: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    runs, out = tmp_path / "runs", tmp_path / "report"
    shutil.copytree(whole, runs)
    spoil, said = BROKEN.get(name) or (HARMLESS[name], None)
    spoil(RunFolder(runs / "small" / "occl" / "probabilistic" / "seed0"))
    assert report.main([f"runs={runs}", f"out={out}"]) == 0
    assert "small/scale/mae_vz/seed0" in capsys.readouterr().out
    pages = {file.name: file.read_text() for file in (out / "site" / "runs").iterdir()}
    good = pages.pop("small-scale-mae_vz-seed0.html")
    assert 'class="note error"' not in good
    assert "Learning curves" in good
    (page,) = pages.values()
    if said is None:
        assert 'class="note error"' not in page, page[page.index('class="note error"') :][:300]
        assert 'id="numbers"' in page
    elif said:
        assert said in page
    for file in (out / "site" / "data").iterdir():
        script = file.read_text()
        content = script[script.index(", ") + 2 : -3]
        json.loads(content, parse_constant=pytest.fail)  # NaN and infinity are not JSON


def test_rows_are_bounded_before_they_are_read(tmp_path: Path) -> None:
    """900,000 equal rows are 121 kB on the disk."""
    names = [f"c{index}" for index in range(30)]
    table = pa.table({name: pa.array(np.zeros(900_000)) for name in names})
    pq.write_table(table, tmp_path / "predictions.parquet", compression="zstd")
    assert (tmp_path / "predictions.parquet").stat().st_size < 200_000
    with pytest.raises(RunError, match=r"has 900000 rows of 30 columns.*expected at most"):
        read_table(tmp_path / "predictions.parquet")

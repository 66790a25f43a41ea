"""`python -m phd_exp report` from the outside."""

from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

from tests.support.recorded import predicted, record
from tests.support.several import write_views


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    record(tmp_path / "runs", "occl", "probabilistic", 0, predicted(0).frame)
    return tmp_path / "runs"


def test_tables_are_printed_and_written(phd_exp: Callable, runs: Path, tmp_path: Path) -> None:
    outcome = phd_exp("report")
    assert (outcome.status, outcome.err) == (0, "")
    assert "The paper's Table 1, preset small: the whole field of view" in outcome.out
    assert "small/occl/probabilistic/seed0" in outcome.out
    assert "tables: report/tables\nfigures: " in outcome.out
    assert len(outcome.out.splitlines()) <= 60
    assert "Missing" not in outcome.out, "nobody has asked for the other runs of the table"
    (long,) = {len(pd.read_csv(file)) for file in [tmp_path / "report" / "measured.csv"]}
    assert len(pd.read_parquet(tmp_path / "report" / "measured.parquet")) == long > 20
    assert {path.name for path in (tmp_path / "report" / "tables").iterdir()} == {
        "table1-small-whole.md",
        "table1-small-whole.tex",
        "table1-small-central.md",
        "table1-small-central.tex",
        "tables.csv",
        "runs.csv",
        ".report.written",
    }


def test_pages_of_others_stay_and_leftovers_go(phd_exp: Callable, runs: Path, tmp_path: Path) -> None:
    site = tmp_path / "report" / "site"
    (site / "runs").mkdir(parents=True)
    mine, leftover = site / "runs" / "mine.html", site / ".index.html.0.phd_exp.tmp"
    for file in (mine, leftover, site / "index.html"):
        file.write_text("mine")
    assert "site/index.html: cannot be written" in phd_exp("report").error
    assert [path.name for path in (tmp_path / "report").iterdir()] == ["site"], "nothing is computed before"
    (site / "index.html").unlink()
    assert (phd_exp("report").status, leftover.exists()) == (0, False)
    (page,) = set((site / "runs").iterdir()) - {mine}
    record(runs, "default", "mae_vz", 0, predicted(0).frame)
    (runs / "small" / "occl").rename(tmp_path / "away")
    again = phd_exp("report")
    assert again.status == 0
    assert "report/site: of an earlier command, " in again.err
    assert (page.exists(), mine.read_text()) == (False, "mine")
    assert len(list((site / "runs").iterdir())) == 2


def test_several_views_are_shown_where_they_are_recorded_and_both_folders_can_be_named(
    phd_exp: Callable, runs: Path, tmp_path: Path
) -> None:
    runs = runs.rename(tmp_path / "elsewhere")
    out = tmp_path / "for the paper"
    views = runs / "small" / "occl" / "probabilistic" / "seed0" / "views.parquet"
    write_views(views, 6)
    outcome = phd_exp("report", "out=for the paper", "runs=elsewhere")
    assert (outcome.status, outcome.err) == (0, "")
    assert (out / "tables" / "fusion-small-occl-probabilistic-seed0.tex").exists()
    assert 'id="of-fusion"' in (out / "site" / "index.html").read_text()
    assert not (tmp_path / "report").exists()
    views.write_bytes(b"torn")
    torn = phd_exp("report", "out=for the paper", "runs=elsewhere")
    assert torn.status == 0
    page = out / "site" / "runs" / "small-occl-probabilistic-seed0.html"
    assert "views.parquet: cannot be read" in page.read_text()
    assert "tables: for the paper/tables\n" in torn.out


def test_nothing_is_written_where_nothing_is_recorded(phd_exp: Callable, tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    outcome = phd_exp("report")
    assert outcome.status == 0
    assert outcome.out.startswith("no runs recorded yet; begin by: python -m phd_exp -m experiment=table1")
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]

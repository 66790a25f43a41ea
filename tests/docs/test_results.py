"""The tables of results are those of docs/results, and what is taken again replaces its lines."""

import shutil
import subprocess
import sys
from hashlib import sha256
from pathlib import Path

import pandas as pd
import pytest

from phd_exp.reports.table import NOTHING
from tests.docs.pages import ROOT

PAGES = ("README.md", "docs/guides/tables.md")
KEY = {"preset": "full+strong", "data": "default", "model": "probabilistic", "table": "table1"}


def write(folder: Path, *words: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "docs/results/write.py", *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True)


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """The pages and the results in another folder."""
    shutil.copytree(ROOT / "docs" / "results", tmp_path / "docs" / "results")
    for page in PAGES:
        (tmp_path / page).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / page, tmp_path / page)
    return tmp_path


def test_the_pages_have_the_results_of_the_files() -> None:
    found = write(ROOT, "--check")
    assert (found.returncode, found.stderr) == (0, "")


def test_numbers_taken_again_replace_the_old_ones(copied: Path) -> None:
    results, taken = copied / "docs" / "results", copied / "report" / "tables"
    taken.mkdir(parents=True)
    for name in ("runs", "calibration"):
        shutil.copy(results / f"{name}.csv", taken)
    lines = pd.read_csv(results / "tables.csv", dtype=str, keep_default_na=False)
    again = lines[(lines[list(KEY)] == pd.Series(KEY)).all(axis=1)]
    again.assign(mean="123456.0").to_csv(taken / "tables.csv", index=False)
    assert write(copied, "--take", "report").returncode == 0
    after = pd.read_csv(results / "tables.csv", dtype=str, keep_default_na=False)
    assert len(after) == len(lines)
    assert (after["mean"] == "123456.0").sum() == len(again) > 0
    assert all("1234" not in (ROOT / page).read_text() != (copied / page).read_text() for page in PAGES)


def test_a_run_with_the_positions_of_the_authors_has_a_row(copied: Path) -> None:
    file = copied / "docs" / "results" / "runs.csv"
    runs = pd.read_csv(file, dtype=str, keep_default_na=False)
    runs = runs[runs["overrides"] == ""]
    plain = runs[(runs["model"] == "probabilistic") & (runs["data"] == "occl") & (runs["seed"] == "0")]
    of_half = plain.assign(overrides=sha256(b"data.xy_range=0.5").hexdigest()[:8], mean="12345.6", high="12346.6")
    pd.concat([runs, of_half]).to_csv(file, index=False)
    assert write(copied).returncode == 0
    (row,) = (line for line in (copied / "README.md").read_text().splitlines() if "the authors' positions |" in line)
    assert row.split(" | ")[1:] == [NOTHING, "12345.6 ± 1.0† / 12346 ± 1†", NOTHING, f"{NOTHING} |"]


def test_a_page_that_differs_is_named(copied: Path) -> None:
    page = copied / "README.md"
    page.write_text(page.read_text().replace("| `preset=full recipe=strong` | ", "| `preset=full recipe=strong` | 0"))
    found = write(copied, "--check")
    assert found.returncode == 1
    assert found.stderr == "README.md: differs from docs/results; run python docs/results/write.py\n"

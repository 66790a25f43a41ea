"""The tables of results are those of docs/results, and what is taken again replaces its lines."""

import io
import re
import runpy
import shutil
import sys
from contextlib import redirect_stderr
from hashlib import sha256
from pathlib import Path

import pandas as pd
import pytest

from phd_exp.reports.table import NOTHING
from tests.docs.pages import ROOT

PAGES = ("README.md", *(f"docs/results/{page.name}" for page in sorted((ROOT / "docs" / "results").glob("*.md"))))
CHANGED = ("README.md", "docs/results/tables.md")
KEY = {"preset": "full+strong", "data": "default", "model": "probabilistic", "table": "table1"}

MEASURED = re.compile(r"\d[\d.,]* ?(?:%|(?:mm|cm|ms|nats|dB|images/s|[MG]B|minutes|hours|points)\b)")
LEVELS = {f"{share} %" for share in (5, 10, 50, 80, 90, 95, 99)}
OTHERS = {
    "own_object.md": {"1 mm", "128 MB"},  # limits
    "ideas/fusion.md": {"87.8 %", "88.8 %"},  # theory, as the lower bounds of the report
    "report.md": {"291 mm", "336 mm", "370 mm", "331 mm", "278 mm", "500 mm", "400 mm", "36 mm", "9 mm"},
    "calibration.md": {"2.5 %", "100 %"},
    "shift.md": {"52 %"},  # of the shift `hidden`
    "train.md": {"20 %", "40 minutes"},  # of the data set `scale`; the order of magnitude of a preset
    "recipe.md": {"9.95 nats", "32 points"},  # the goal of the speed record, a key
}
"""Numbers that no measurement has given, by page."""


def write(folder: Path, *words: object) -> tuple[object, str]:
    """Exit status and errors of the script, in this process, which has imported what it needs."""
    script = folder / "docs" / "results" / "write.py"
    with pytest.MonkeyPatch.context() as patch, redirect_stderr(io.StringIO()) as errors:
        patch.setattr(sys, "argv", [str(script), *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(script), run_name="__main__")
    return ended.value.code, errors.getvalue()


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """The pages and the results in another folder."""
    shutil.copytree(ROOT / "docs" / "results", tmp_path / "docs" / "results")
    for page in PAGES:
        (tmp_path / page).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / page, tmp_path / page)
    return tmp_path


def test_the_pages_have_the_results_of_the_files() -> None:
    assert write(ROOT, "--check") == (0, "")


def test_numbers_taken_again_replace_the_old_ones(copied: Path) -> None:
    results, taken = copied / "docs" / "results", copied / "report" / "tables"
    taken.mkdir(parents=True)
    for name in ("runs", "calibration"):
        shutil.copy(results / f"{name}.csv", taken)
    lines = pd.read_csv(results / "tables.csv", dtype=str, keep_default_na=False)
    again = lines[(lines[list(KEY)] == pd.Series(KEY)).all(axis=1)]
    again.assign(mean="123456.0").to_csv(taken / "tables.csv", index=False)
    assert write(copied, "--take", copied / "report") == (0, "")
    after = pd.read_csv(results / "tables.csv", dtype=str, keep_default_na=False)
    assert len(after) == len(lines)
    assert (after["mean"] == "123456.0").sum() == len(again) > 0
    assert all("1234" not in (ROOT / page).read_text() != (copied / page).read_text() for page in CHANGED)


def test_a_run_with_the_positions_of_the_authors_has_a_row(copied: Path) -> None:
    file = copied / "docs" / "results" / "runs.csv"
    runs = pd.read_csv(file, dtype=str, keep_default_na=False)
    runs = runs[runs["overrides"] == ""]
    plain = runs[(runs["model"] == "probabilistic") & (runs["data"] == "occl") & (runs["seed"] == "0")]
    of_half = plain.assign(overrides=sha256(b"data.xy_range=0.5").hexdigest()[:8], mean="12345.6", high="12346.6")
    pd.concat([runs, of_half]).to_csv(file, index=False)
    assert write(copied) == (0, "")
    label = "| authors' positions: `preset=full recipe=strong` |"
    (row,) = (
        line
        for line in (copied / "docs" / "results" / "tables.md").read_text().splitlines()
        if line.startswith(label)
    )
    assert row.split(" | ")[1:] == [NOTHING, "12345.6 ± 1.0† / 12346 ± 1†", NOTHING, f"{NOTHING} |"]


def test_a_page_that_differs_is_named(copied: Path) -> None:
    page = copied / "README.md"
    page.write_text(page.read_text().replace("| the same, whole field | ", "| the same, whole field | 0"))
    expected = "README.md: differs from docs/results; run python docs/results/write.py\n"
    assert write(copied, "--check") == (1, expected)


def test_no_guide_has_a_measured_number() -> None:
    for page in (*(ROOT / "docs" / "guides").glob("*.md"), *(ROOT / "docs" / "ideas").glob("*.md")):
        text = re.sub(r"^```.*?^```$|^ {4}.*$|`[^`]*`", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
        known = LEVELS.union(*(found for name, found in OTHERS.items() if str(page).endswith(name)))
        assert set(MEASURED.findall(text)) <= known, f"{page.name}: numbers of measurements belong to docs/results"

"""Runs that earlier versions recorded stay readable: `old_runs.tar.xz` is never written again.

`old_runs.md` says how each was made.
"""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

import phd_exp as package
from tests.golden.compare import PLACE, read
from tests.golden.conftest import boxed, lines, photograph, placed


@pytest.fixture
def old_runs(tmp_path: Path) -> Path:
    """The folder of the old runs, in the folder where commands are run."""
    shutil.unpack_archive(PLACE / "old_runs.tar.xz", tmp_path, filter="data")
    return tmp_path / "runs"


def test_old_runs_are_reported(
    golden: Callable, phd_exp: Callable, old_runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for made in ("paper_figures.write_figures", "site.build.write_site"):  # no figures and pages, for speed
        monkeypatch.setattr(f"phd_exp.reports.{made}", lambda *arguments: [])
    outcome = phd_exp("report", "runs=runs", "out=report")
    assert (outcome.status, outcome.err) == (0, "")
    found = {file.name: read(file) for file in (tmp_path / "report" / "tables").glob("*.csv")}
    # four held-out sequences choose the time constants of slow errors at a flat optimum, which rounding moves
    found["tracks.csv"] = [row for row in found["tracks.csv"] if row["method"] != "slow"]
    golden("report", found)


def test_old_runs_are_listed(golden: Callable, old_runs: Path) -> None:
    listed = package.runs(old_runs).drop(columns="path")
    golden("listed", {"runs.csv": listed.astype(object).where(listed.notna(), "").to_dict("records")})


def test_old_networks_predict(golden: Callable, phd_exp: Callable, old_runs: Path, tmp_path: Path) -> None:
    folder = photograph(tmp_path / "photographs", [boxed(placed(number)) for number in range(3)])
    made = {}
    for model, words in {"probabilistic": ("recalibrate=true", "coverage=0.5"), "mae_logz": ()}.items():
        (run,) = (old_runs / "smoke" / "default" / model).glob("seed0*")
        made[f"{model}.jsonl"] = lines(phd_exp("predict", f"run={run}", f"folder={folder}", *words))
    golden("old_networks", made)

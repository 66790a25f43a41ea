"""Scores under shift: shares and thresholds by counting, and tables with few or no finite rows."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from phd_exp.evaluation.familiar import Familiarity
from phd_exp.evaluation.parquet import read_table
from phd_exp.evaluation.shifts import shift_scores
from phd_exp.records.errors import RunError
from phd_exp.records.runs import RunFolder
from tests.support.synthetic import write_run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A calibrated run with a shift in which it is overconfident, and held-out samples like home."""
    folder = tmp_path_factory.mktemp("runs")
    run = write_run(folder, "default", n=200)
    run.shifts.mkdir()
    write_run(folder / "1", "default", seed=1, n=100, overconfidence=3.0).predictions.rename(run.shift("odd"))
    write_run(folder / "2", "default", seed=2, n=60).predictions.rename(run.held_out)
    return run


def test_every_share_is_a_count(run: RunFolder) -> None:
    held_out = read_table(run.held_out)
    found = shift_scores(run.shifts, read_table(run.predictions), held_out)
    assert found.keys() == {"home", "odd"}
    odd = np.sort(held_out["level"][1::2])
    for name, file in (("home", run.predictions), ("odd", run.shift("odd"))):
        table = pd.read_parquet(file)
        levels = {"inside_50": 0.5, "inside_90": 0.9, "inside_99": 0.99, "inside_conformal": odd[27]}  # of 30
        for key, level in levels.items():
            band = found[name].scores[key]
            assert band.value == pytest.approx(100 * (table["level"] <= level).mean())
            assert band.low <= band.value <= band.high
        for key in ("depth_error_mm", "projected_error_mm", "nll"):
            assert found[name].scores[key].value == pytest.approx(table[key].mean())
        sharpness = 1000 * np.sqrt(table["depth_variance"].mean())
        assert found[name].scores["depth_sharpness_mm"].value == pytest.approx(sharpness)
        assert (found[name].n, found[name].left_out) == (len(table), 0)
        distance = Familiarity(held_out).distance(read_table(file))
        usual = Familiarity(held_out).distance(read_table(run.predictions))
        auroc = stats.mannwhitneyu(distance, usual).statistic / (len(distance) * len(usual))
        assert found[name].scores["auroc"].value == pytest.approx(auroc)
        alarms = Familiarity(held_out).p_value(distance) < 0.05
        assert found[name].scores["unfamiliar"].value == pytest.approx(100 * alarms.mean())
    home, shifted = (found[name].scores["inside_90"] for name in ("home", "odd"))
    assert home.low <= 90 <= home.high
    assert shifted.high < 80


def test_rows_that_are_not_finite_are_counted(run: RunFolder, tmp_path: Path) -> None:
    table = pd.read_parquet(run.predictions)
    table.loc[:4, "nll"] = np.inf
    table.to_parquet(tmp_path / "far.parquet")
    home = read_table(run.predictions)
    found = shift_scores(tmp_path, home, None)["far"]
    assert (found.n, found.left_out) == (195, 5)
    assert "inside_conformal" not in found.scores
    table.drop(columns="level").to_parquet(tmp_path / "far.parquet")
    with pytest.raises(RunError, match="no column level"):
        shift_scores(tmp_path, home, None)
    assert shift_scores(tmp_path, {"x": home["x"]}, None) == {}, "point estimates have no regions"
    assert shift_scores(tmp_path / "nothing", home, None) == {}

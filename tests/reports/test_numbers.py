"""The long table: its intervals and tests have the probabilities that they claim; every number is a row."""

from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import phd_exp
from phd_exp.evaluation.point_errors import paired
from phd_exp.metrics.bootstrap import Interval
from phd_exp.reports.numbers import COLUMNS, SAME, differences, over_seeds
from phd_exp.reports.report import read_report
from tests.support.recorded import predicted, record


def seeds_of(values: np.ndarray, half: float = 0.0, **columns: str) -> pd.DataFrame:
    """One number of several seeds, each with the interval ± half."""
    found = pd.DataFrame({"value": values, "low": values - half, "high": values + half, "n": 10})
    return found.assign(**dict.fromkeys(SAME, "")).assign(seed=range(len(values)), images="", **columns)


def test_the_interval_covers_as_often_as_it_claims() -> None:
    """Three seeds at a time on the same test samples, from known laws: 95 % of 4000 intervals hold the mean."""
    random = np.random.default_rng(0)
    for of_seeds, of_samples in ((7.0, 0.5), (2.0, 7.0)):
        drawn = random.normal(50, of_seeds, (4000, 3)) + random.normal(0, of_samples, (4000, 1))
        found = over_seeds(seeds_of(drawn.ravel(), 1.96 * of_samples).assign(data=np.arange(12_000) // 3))
        assert (found["seeds"] == 3).all()
        held = (found["low"] <= 50) & (found["high"] >= 50)
        assert held.mean() == pytest.approx(0.955, abs=0.02)
    (one,) = over_seeds(seeds_of(np.array([12.0]), np.nan)).itertuples()
    assert (one.value, np.isnan(one.low), one.seeds) == (12.0, True, 1)
    (one,) = over_seeds(seeds_of(np.array([12.0]), 2.0)).itertuples()
    assert (one.low, one.high) == (10.0, 14.0)


@pytest.mark.parametrize("seeds", [3, 5])
def test_equal_models_are_rarely_separated_and_different_ones_often(seeds: int) -> None:
    """2000 pairs of models: 5 % of the equal ones are separated, in either direction."""
    random = np.random.default_rng(seeds)
    separated = {0.0: 0, -30.0: 0}
    for shift, values in product(separated, random.normal(100, 3, (2000, 2, seeds))):
        gap, p = paired(dict(enumerate(values[0] + shift)), dict(enumerate(values[1])))
        assert (p < 0.05) == (not gap.low <= 0 <= gap.high)
        separated[shift] += p < 0.05
    assert separated[0.0] / 2000 == pytest.approx(0.05, abs=0.02)
    assert separated[-30.0] / 2000 > 0.95


def test_only_seeds_of_both_on_the_same_images_are_compared() -> None:
    assert paired({0: 1.0}, dict.fromkeys(range(3), 9.0)) == (Interval(-8.0, -np.inf, np.inf), 1.0)
    assert paired({0: 1.0, 1: 2.0}, {3: 9.0, 4: 8.0})[1] == 1.0, "seeds are paired"
    ours, other = seeds_of(np.array([1.0, 3.0]), model="ours"), seeds_of(np.array([2.0, 2.5, 9.0]), model="other")
    (gap,) = differences(pd.concat([ours, other]), "model", "other").itertuples()
    assert (gap.model, gap.value, gap.seeds) == ("ours", -0.25, 2)
    for unlike in (other.assign(images="others"), other.assign(n=11), other.assign(data="others")):
        assert differences(pd.concat([ours, unlike]), "model", "other").empty


def test_numbers_are_those_of_the_tables_and_of_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for seed in (0, 1):
        record(tmp_path / "runs", "occl", "probabilistic", seed, predicted(seed).frame)
    found = phd_exp.measured("runs")
    pd.testing.assert_frame_equal(found, read_report(tmp_path / "runs").long.reset_index(drop=True))
    assert tuple(found.columns) == COLUMNS
    assert not found.duplicated(list(COLUMNS[:5])).any()
    depth = found[
        (found["quantity"] == "depth_error_mm") & (found["subject"] == "whole") & (found["method"] == "mode")
    ]
    depth = depth.set_index("run")["value"]
    seeds = [depth[f"small/occl/probabilistic/seed{seed}"] for seed in (0, 1)]
    assert depth["small/occl/probabilistic/seeds"] == pytest.approx(np.mean(seeds))
    assert depth["paper/occl/probabilistic"] == 168
    assert not (tmp_path / "report").exists()

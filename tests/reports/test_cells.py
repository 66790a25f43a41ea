"""Means over seeds and their intervals, against scipy's."""

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from phd_exp.evaluation.point_errors import ErrorKey, SampleMean
from phd_exp.reports.cells import Cell, interval, make_cell, seeds_of
from phd_exp.reports.collect import collect
from tests.reports.recorded import by_hand, predicted, record

KEY = ErrorKey("median", "central", "depth")


def made(runs: Path, seeds: tuple[int, ...]) -> Cell:
    return make_cell(collect(runs), "small", "occl", "probabilistic", KEY, seeds)


def test_several_seeds_against_a_hand_computation(tmp_path: Path) -> None:
    means = []
    for seed in (0, 1, 4):
        drawn = predicted(seed, noise=0.01 * (1 + seed))
        record(tmp_path, "occl", "probabilistic", seed, drawn.frame)
        means.append(by_hand(drawn, "median", "depth")[(np.abs(drawn.v_p) <= 0.5).all(axis=1)].mean())
    cell = made(tmp_path, (0, 1, 4))
    expected = stats.ttest_1samp(means, 0).confidence_interval(0.95)
    assert cell.interval is not None
    assert cell.interval.kind == "student_t_over_seeds"
    assert cell.mean == pytest.approx(np.mean(means), rel=1e-9)
    assert cell.interval.low == pytest.approx(expected.low, rel=1e-9)
    assert cell.interval.high == pytest.approx(expected.high, rel=1e-9)
    assert (cell.seeds, cell.state) == ((0, 1, 4), "finished")


def test_one_seed_against_a_hand_computation(tmp_path: Path) -> None:
    drawn = predicted(0)
    record(tmp_path, "occl", "probabilistic", 0, drawn.frame)
    values = by_hand(drawn, "median", "depth")[(np.abs(drawn.v_p) <= 0.5).all(axis=1)]
    cell = made(tmp_path, (0,))
    assert cell.interval is not None
    assert cell.interval.kind == "normal_over_samples"
    assert cell.interval.half_width == pytest.approx(1.959963984540054 * stats.sem(values), rel=1e-9)
    assert cell.n_test == (len(values),)


def test_one_sample_of_one_seed_has_no_interval() -> None:
    found = interval([SampleMean(1, 12.0, None)])
    assert (found.mean, found.low, found.high, found.kind) == (12.0, None, None, "none")


def test_the_interval_covers_as_often_as_it_says() -> None:
    """Three seeds a time, 4000 times, from a known law: 95 % of the intervals hold its mean."""
    random = np.random.default_rng(0)
    held = 0
    for values in random.normal(50, 7, (4000, 3)):
        found = interval([SampleMean(10, value, 1.0) for value in values])
        assert found.low is not None
        assert found.high is not None
        held += found.low <= 50 <= found.high
    assert held / 4000 == pytest.approx(0.95, abs=0.015)  # four standard errors


def test_gaps_are_named_and_the_rest_is_averaged(tmp_path: Path) -> None:
    record(tmp_path, "occl", "probabilistic", 0, predicted(0).frame)
    record(tmp_path, "occl", "probabilistic", 1)
    cell = made(tmp_path, (0, 1, 2))
    assert cell.seeds == (0,)
    assert [(gap.seed, gap.state) for gap in cell.gaps] == [(1, "unreadable"), (2, "missing")]
    assert cell.state == "1 of 3 seeds"
    assert cell.interval is not None


def test_a_cell_without_a_number_says_why(tmp_path: Path) -> None:
    assert made(tmp_path, (0,)).state == "missing"
    drawn = predicted(0)
    record(tmp_path, "occl", "probabilistic", 0, drawn.frame[(np.abs(drawn.v_p) > 0.5).any(axis=1)])
    cell = made(tmp_path, (0,))
    assert (cell.state, cell.interval, cell.mean, cell.ratio) == ("no sample", None, None, None)


def test_the_seeds_of_a_table_are_all_that_any_of_its_runs_has(tmp_path: Path) -> None:
    record(tmp_path, "occl", "mae_vz", 2)
    record(tmp_path, "occl", "probabilistic", 0)
    record(tmp_path, "scale", "probabilistic", 7)
    record(tmp_path, "occl", "probabilistic", 9, overrides=("optimizer.lr=1",))
    choices = [("occl", "mae_vz"), ("occl", "probabilistic")]
    assert seeds_of(collect(tmp_path), "small", choices) == [0, 2]

"""Means over seeds and their intervals, against scipy's."""

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from phd_exp.evaluation.point_errors import ErrorKey, SampleMean, difference
from phd_exp.metrics.bootstrap import Interval
from phd_exp.reports.cells import Cell, interval, make_cell
from phd_exp.reports.runs import read_report
from tests.support.recorded import by_hand, predicted, record

KEY = ErrorKey("median", "central", "depth")


def made(runs: Path, seeds: tuple[int, ...]) -> Cell:
    return make_cell(read_report(runs), "small", "occl", "probabilistic", KEY, seeds)


def half_width_of(interval: Interval[float]) -> float:
    return (interval.high - interval.low) / 2


def test_several_seeds_against_a_hand_computation(tmp_path: Path) -> None:
    means, errors = [], []
    for seed in (0, 1, 4):
        drawn = predicted(seed, noise=0.01 * (1 + seed))
        record(tmp_path, "occl", "probabilistic", seed, drawn.frame)
        values = by_hand(drawn, "median", "depth")[(np.abs(drawn.v_p) <= 0.5).all(axis=1)]
        means.append(values.mean())
        errors.append(stats.sem(values))
    cell = made(tmp_path, (0, 1, 4))
    of_seeds = stats.ttest_1samp(means, 0).confidence_interval(0.95).high - np.mean(means)
    half_width = np.hypot(of_seeds, 1.959963984540054 * np.mean(errors))
    assert cell.interval is not None
    assert cell.scatter == "seeds_and_samples"
    assert cell.mean == cell.interval.value == pytest.approx(np.mean(means), rel=1e-9)
    assert half_width_of(cell.interval) == pytest.approx(half_width, rel=1e-9)
    assert (list(cell.means), cell.state) == ([0, 1, 4], "finished")


def test_one_seed_against_a_hand_computation(tmp_path: Path) -> None:
    drawn = predicted(0)
    record(tmp_path, "occl", "probabilistic", 0, drawn.frame)
    values = by_hand(drawn, "median", "depth")[(np.abs(drawn.v_p) <= 0.5).all(axis=1)]
    cell = made(tmp_path, (0,))
    assert cell.interval is not None
    assert cell.scatter == "samples"
    assert half_width_of(cell.interval) == pytest.approx(1.959963984540054 * stats.sem(values), rel=1e-9)
    assert cell.means[0].n == len(values)
    assert interval([SampleMean(1, 12.0, None)]) is None


def test_the_interval_covers_as_often_as_it_claims() -> None:
    """Three seeds at a time on the same test samples, from known laws: 95 % of 4000 intervals hold the mean."""
    random = np.random.default_rng(0)
    for of_seeds, of_samples in ((7.0, 0.5), (2.0, 7.0)):
        held = 0
        for values in random.normal(50, of_seeds, (4000, 3)) + random.normal(0, of_samples, (4000, 1)):
            found = interval([SampleMean(10, value, of_samples) for value in values])
            assert found is not None
            held += found.low <= 50 <= found.high
        assert held / 4000 == pytest.approx(0.955, abs=0.02)


def test_gaps_are_named_and_the_rest_is_averaged(tmp_path: Path) -> None:
    record(tmp_path, "occl", "probabilistic", 0, predicted(0).frame)
    record(tmp_path, "occl", "probabilistic", 1)
    cell = made(tmp_path, (0, 1, 2))
    assert list(cell.means) == [0]
    assert [(seed, reason.split(":")[0]) for seed, reason in cell.gaps.items()] == [(1, "unreadable"), (2, "missing")]
    assert cell.state == "1 of 3 seeds"
    assert cell.interval is not None


def test_a_cell_without_a_number_has_a_reason(tmp_path: Path) -> None:
    assert made(tmp_path, (0,)).state == "missing"
    drawn = predicted(0)
    record(tmp_path, "occl", "probabilistic", 0, drawn.frame[(np.abs(drawn.v_p) > 0.5).any(axis=1)])
    cell = made(tmp_path, (0,))
    assert (cell.state, cell.interval, cell.mean, cell.ratio) == ("no sample", None, None, None)


@pytest.mark.parametrize("seeds", [2, 5])
def test_equal_models_are_rarely_separated_and_different_ones_often(seeds: int) -> None:
    """Means of two models on shared images, 100 times: errors of images are shared, those of trainings are not."""
    random = np.random.default_rng(seeds)
    counts = random.multinomial(80, [1 / 80] * 80, 100) / 80

    def means(shift: float, images: np.ndarray) -> list[SampleMean]:
        trained = random.normal(100 + shift, 3, (seeds, 1)) + images + random.normal(0, 5, (seeds, 80))
        return [SampleMean(80, errors.mean(), 1.0, counts @ errors) for errors in trained]

    separated = {0.0: 0, -30.0: 0}
    for _ in range(100):
        images = random.normal(0, 40, 80)  # hard and easy ones: alike for both models
        for shift in separated:
            gap = difference(means(shift, images), means(0.0, images))
            separated[shift] += not gap.low <= 0 <= gap.high
    assert separated[0.0] / 100 <= 0.05 + 4 * np.sqrt(0.05 * 0.95 / 100)
    assert separated[-30.0] / 100 > 0.85


def test_one_seed_is_never_separated() -> None:
    one = [SampleMean(10, 1.0, 0.1, np.full(200, 1.0))]
    assert difference(one, [SampleMean(10, 9.0, 0.1, np.full(200, 9.0))] * 3) == Interval(-8.0, -np.inf, np.inf)

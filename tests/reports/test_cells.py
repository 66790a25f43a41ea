"""Intervals of means over seeds, and tests of differences, have the probabilities that they claim."""

import numpy as np
import pytest

from phd_exp.evaluation.point_errors import SampleMean, difference
from phd_exp.metrics.bootstrap import Interval
from phd_exp.reports.cells import interval


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
    assert interval([SampleMean(1, 12.0, None)]) is None


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

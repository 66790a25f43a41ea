"""Intervals of means over seeds, and tests of differences, have the probabilities that they claim."""

from itertools import product

import numpy as np
import pytest

from phd_exp.evaluation.point_errors import SampleMean, paired
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


def test_one_seed_is_never_separated() -> None:
    assert paired({0: 1.0}, dict.fromkeys(range(3), 9.0)) == (Interval(-8.0, -np.inf, np.inf), 1.0)
    assert paired({0: 1.0, 1: 2.0}, {3: 9.0, 4: 8.0})[1] == 1.0, "seeds are paired"

"""Familiarity: uniform p-values for samples like the held-out ones, small ones for any unusual number."""

import numpy as np
import pytest
from scipy import stats

from phd_exp.distributions import Temperature
from phd_exp.evaluation.familiar import Familiarity
from phd_exp.evaluation.predictions import recalibrated
from phd_exp.records.errors import RunError

UNUSUAL = {"mu_z": 2.0, "a": 0.02, "f": 2.0, "A_xx": 1e-4, "disagreement": 1e3}
"""Column -> a factor that makes it unlike all held-out samples."""


def predicted(n: int, seed: int) -> dict[str, np.ndarray]:
    random = np.random.default_rng(seed)
    table = {name: np.zeros(n) for name in ("mu_x", "mu_y", "A_xy", "x", "y")}
    A = np.exp(random.normal(5, 0.3, n))
    table |= {"mu_z": random.uniform(3, 5, n), "z": np.full(n, 4.0), "A_xx": A, "A_yy": A, "S": np.full(n, 224.0)}
    table |= {"a": np.exp(0.5 * np.log(A) + random.normal(2, 0.2, n)), "f": random.uniform(1200, 2000, n)}
    return table | {"disagreement": np.exp(random.normal(-3, 1, n))}


def test_p_values_are_uniform_over_many_sets_of_held_out_samples() -> None:
    found = []
    for seed in range(40):
        familiarity = Familiarity(predicted(100, seed))
        found += familiarity.p_value(familiarity.distance(predicted(25, 1000 + seed))).tolist()
    shares = np.array([0.05, 0.1, 0.25, 0.5, 0.75])
    assert [np.mean(np.array(found) <= share) for share in shares] == pytest.approx(shares, abs=0.05)
    assert stats.kstest(found, "uniform").statistic < 0.06


@pytest.mark.parametrize("column", UNUSUAL)
def test_an_unusual_number_makes_a_sample_unfamiliar(column: str) -> None:
    familiarity, usual = Familiarity(predicted(2000, 0)), predicted(200, 1)
    unusual = usual | {column: usual[column] * UNUSUAL[column]}
    assert np.mean(familiarity.p_value(familiarity.distance(unusual)) < 0.05) > 0.9
    assert np.mean(familiarity.p_value(familiarity.distance(usual)) < 0.05) < 0.12


def test_a_quantity_that_never_varied_counts_when_it_changes() -> None:
    held_out = predicted(200, 0) | {"f": np.full(200, 1500.0)}
    familiarity, usual = Familiarity(held_out), predicted(50, 1)
    for f, least, most in ((1500.0, 0.25, 0.85), (1505.0, 0.25, 0.85), (2000.0, 0.0, 0.01)):
        changed = usual | {"f": np.full(50, f)}
        assert least <= np.median(familiarity.p_value(familiarity.distance(changed))) <= most, f


def test_temperatures_change_nothing_and_extreme_predictions_are_unfamiliar() -> None:
    held_out, usual, temperature = predicted(100, 0), predicted(20, 1), Temperature(projected=2.0, depth=0.5)
    held_out |= {"nll": np.zeros(100)}
    one, other = Familiarity(held_out), Familiarity(held_out, temperature)
    hot = recalibrated(usual, temperature)
    np.testing.assert_allclose(other.distance(hot), one.distance(usual), rtol=1e-6)
    for value in (0.0, np.inf, np.nan):
        assert one.p_value(one.distance(usual | {"a": np.full(20, value)})).max() == 1 / 51


def test_too_few_held_out_samples_are_an_error_that_says_how_many() -> None:
    with pytest.raises(RunError, match="needs at least 40 held-out samples; found 38"):
        Familiarity(predicted(38, 0))
    held_out = predicted(100, 0)
    del held_out["S"]
    with pytest.raises(RunError, match="no column S"):
        Familiarity(held_out)

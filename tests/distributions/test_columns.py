"""Densities as columns of a table, and the normalised estimation error squared."""

import pytest
import torch

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.columns import (
    NEES,
    distribution_columns,
    draws,
    from_columns,
    nees_columns,
    parameter_columns,
)
from phd_exp.metrics.errors import squared_mahalanobis
from tests.distributions.test_laws import samples
from tests.support.densities import INSTANCES, from_raw
from tests.support.random_problems import random_problems


def test_a_table_has_k_only_with_a_free_axis_and_rebuilds_it() -> None:
    generator = torch.Generator().manual_seed(4)
    for numbers in (7, 9):
        raw = torch.randn(20, numbers, generator=generator, dtype=torch.float64)
        p = from_raw(raw)
        xyz = p.rsample((), generator)
        table = distribution_columns(p, xyz)
        assert ("k_x" in table) == ("k_y" in table) == (numbers == 9)
        assert parameter_columns(p).keys() <= table.keys()
        for name, column in distribution_columns(from_columns(table), xyz).items():
            torch.testing.assert_close(column, table[name], rtol=1e-6, atol=1e-8)


def test_nees_is_the_squared_mahalanobis_distance() -> None:
    predictions = random_problems(200, 1, free_axis=True)[0][:, 0]
    xyz = predictions.rsample((3,), torch.Generator().manual_seed(0))
    covariance = predictions.covariance_matrix.expand(3, -1, 3, 3)
    expected = squared_mahalanobis(xyz - predictions.mean, covariance)
    torch.testing.assert_close(nees_columns(predictions, xyz)["nees"], expected)


@pytest.mark.parametrize("name", [name for name, p in INSTANCES.items() if p.rounding == 0])
def test_nees_of_own_samples_average_3_and_1_per_axis(name: str) -> None:
    found = nees_columns(INSTANCES[name], samples(name))
    for key, mean in zip(NEES, (3, 1, 1, 1), strict=True):
        assert float(found[key].mean()) == pytest.approx(
            mean, abs=5 * float(found[key].std()) / len(found[key]) ** 0.5
        )
    assert float(found["nees"].var()) > 6  # of chi-squared
    too_precise = nees_columns(INSTANCES[name].tempered(0.5, 0.5), samples(name))
    assert float(too_precise["nees"].mean()) > 6


def test_draws_are_seeded_samples() -> None:
    truth, state = ProjectedHuber.from_raw(torch.zeros(9, 7), f=1500.0, S=224.0, mu_z0=2.5e-3), torch.get_rng_state()
    one, same, other = (draws(truth, 3, seed) for seed in (1, 1, 2))
    assert torch.equal(torch.get_rng_state(), state)
    assert torch.equal(one, same)
    assert not torch.equal(one, other)

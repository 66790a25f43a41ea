"""Normalised estimation error squared: its definition, its exact expectation and spread, by samples and theory."""

import math

import pytest
import torch
from scipy import integrate

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.columns import NEES, nees_columns
from phd_exp.distributions.huber import HUBER_COVARIANCE, RADIAL_NORMALISER
from phd_exp.metrics.errors import squared_mahalanobis
from tests.support.random_problems import random_problems

N = 50_000


def moments(a: float) -> tuple[float, float]:
    """Variance and kurtosis of t under exp(-a max(t, 1/t)), by quadrature."""

    def integral(power: int, centre: float) -> float:
        def value(t: float) -> float:
            return (t - centre) ** power * math.exp(-a * (max(t, 1 / t) - 1))

        return sum(integrate.quad(value, *ends, epsabs=0)[0] for ends in ((0, 1), (1, 1 + 60 / a)))

    total = integral(0, 0)
    mean = integral(1, 0) / total
    variance = integral(2, mean) / total
    return variance, integral(4, mean) / total / variance**2


def test_it_is_the_squared_mahalanobis_distance() -> None:
    predictions = random_problems(200, 1, free_axis=True)[0][:, 0]
    xyz = predictions.rsample((3,), torch.Generator().manual_seed(0))
    found = nees_columns(predictions, xyz)
    covariance = predictions.covariance_matrix.expand(3, -1, 3, 3)
    torch.testing.assert_close(found["nees"], squared_mahalanobis(xyz - predictions.mean, covariance))


@pytest.mark.parametrize("a", [1.0, 5.0, 50.0])
def test_own_samples_average_3_and_1_per_axis_with_the_exact_spread(a: float) -> None:
    """Var[e . C^-1 e] = kurtosis of t - 1 + E|q|^4/c^2 - 4."""
    A = torch.tensor([[300.0, 50.0], [50.0, 200.0]]).double().expand(N, 2, 2)
    mu_xy = torch.tensor([0.05, -0.02]).double().expand(N, 2)
    one = torch.ones(N).double()
    predictions = ProjectedHuber(mu_xy, 4 * one, A, a * one)
    xyz = predictions.rsample((), torch.Generator().manual_seed(0))
    found = nees_columns(predictions, xyz)
    inner, outer = (
        integrate.quad(lambda r, h=h: r**5 * math.exp(-h(r)), *ends)[0]
        for h, ends in ((lambda r: r * r / 2, (0, 1)), (lambda r: r - 0.5, (1, 80)))
    )
    fourth = (inner + outer) / RADIAL_NORMALISER
    variance = moments(a)[1] - 1 + fourth / HUBER_COVARIANCE**2 - 4
    deviation = math.sqrt(variance / N)
    assert float(found["nees"].mean()) == pytest.approx(3, abs=4 * deviation)
    assert float(found["nees"].var()) == pytest.approx(variance, rel=0.25)
    assert variance > 6  # of chi-squared
    for name in NEES[1:]:
        assert float(found[name].mean()) == pytest.approx(1, abs=4 * float(found[name].std()) / math.sqrt(N)), name
    too_precise = nees_columns(predictions.tempered(0.5, 0.5), xyz)
    assert float(too_precise["nees"].mean()) > 3 + 100 * deviation

"""The law of a coordinate along any direction, against samples and quadrature."""

import math

import numpy as np
import pytest
import torch
from scipy import integrate

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.along import marginal, quantiles_along
from tests.support.densities import parameters

P = np.array([0.005, 0.05, 0.25, 0.5, 0.75, 0.95, 0.995])
SIDEWAYS = np.array([0.3, -0.4, math.sqrt(0.75)])
PRECISIONS = [(0.05, 3.0), (3.0, 10.0), (300.0, 5.0), (5.0, 1e4)]


def distribution(a: float, A: float, k: tuple[float, float] = (0.0, 0.0)) -> ProjectedHuber:
    tensors = ([0.1, -0.2], 4.0, [[A, 0.1 * A], [0.1 * A, 2 * A]], a, k)
    return ProjectedHuber(*(torch.tensor(values, dtype=torch.float64) for values in tensors))


def along(one: ProjectedHuber, direction: np.ndarray) -> np.ndarray:
    return quantiles_along(one.expand((1,)), direction[None], P)[0]


@pytest.mark.parametrize("k", [(0.0, 0.0), (0.9, -0.4), (5.0, -9.0)])  # the last leads away from the direction
@pytest.mark.parametrize(("a", "A"), PRECISIONS)
def test_quantiles_are_those_of_samples(a: float, A: float, k: tuple[float, float]) -> None:
    p = distribution(a, A, k)
    n = 50_000
    samples = p.rsample((n,), torch.Generator().manual_seed(0)).numpy() @ SIDEWAYS
    below = (samples[:, None] <= along(p, SIDEWAYS)).mean(axis=0)
    assert (np.abs(below - P) < 4 * np.sqrt(P * (1 - P) / n)).all()


@pytest.mark.parametrize(("a", "A"), PRECISIONS)
def test_hardly_turned_they_are_those_of_depth(a: float, A: float) -> None:
    p = distribution(a, A)
    expected = p.depth_icdf(torch.from_numpy(P)).numpy()
    np.testing.assert_array_equal(along(p, np.array([0.0, 0.0, 1.0])), expected)
    hardly = np.array([1e-7, 0.0, 1.0])
    np.testing.assert_allclose(along(p, hardly), expected, rtol=1e-4)


def test_the_marginal_is_an_integral_of_the_density() -> None:
    at, density, cdf = marginal()
    for place in np.searchsorted(at, [0.0, 0.3, 0.999, 1.0, 2.5, 20.0]):
        s = at[place]

        def integrand(w: float, s: float = s) -> float:
            r = math.hypot(s, w)
            return math.exp(-(r * r / 2 if r <= 1 else r - 0.5)) / (2 * math.pi * (1 + math.exp(-0.5)))

        seam = math.sqrt(max(0, 1 - s * s))
        expected = 2 * (integrate.quad(integrand, 0, seam)[0] + integrate.quad(integrand, seam, 60, limit=200)[0])
        assert density[place] == pytest.approx(expected, rel=1e-5)
        assert cdf[place] == pytest.approx(0.5 + np.trapz(density[: place + 1], at[: place + 1]), abs=1e-7)


def test_a_batch_has_the_quantiles_of_its_distributions() -> None:
    several = [distribution(a, A, k) for (a, A), k in zip(PRECISIONS, [(0, 0), (5, -9), (0, 0), (1, 1)], strict=True)]
    columns = zip(*(parameters(one).values() for one in several), strict=True)
    directions = np.array([SIDEWAYS, [0.0, 0.0, 1.0], [1e-3, 0.0, 1.0], -SIDEWAYS * [1, 1, -1]])
    together = quantiles_along(ProjectedHuber(*map(torch.stack, columns)), directions, P)
    alone = np.stack([along(one, direction) for one, direction in zip(several, directions, strict=True)])
    np.testing.assert_allclose(together, alone, rtol=1e-6)


def test_a_direction_away_from_the_mode_is_refused() -> None:
    with pytest.raises(ValueError, match="90 degrees"):
        along(distribution(3.0, 10.0), -SIDEWAYS)

"""The score of depths against quadrature of its definition, its derivative, samples, and known laws."""

import itertools
import math

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

from phd_exp.distributions import ProjectedHuber, depth
from phd_exp.distributions.depth import crps_beyond_distance, half_mean_difference

PRECISIONS = [1e-3, 0.3, 0.999, 1.0, 1.001, 30.0, 1e4, 1e6]
NODES, WEIGHTS = np.polynomial.legendre.leggauss(40)


@pytest.fixture(params=PRECISIONS, ids="a={:g}".format)
def log_a(request: pytest.FixtureRequest) -> torch.Tensor:
    return torch.tensor(request.param, dtype=torch.float64).log()


def by_quadrature(log_t: float, log_a: torch.Tensor) -> float:
    """int (F(u) - 1[u >= t])^2 du in u = e^x, between borders around which F changes."""
    p = torch.tensor(
        [1e-12, 1e-9, 1e-6, 1e-4, 0.01, 0.1, 0.3, 0.6, 0.9, 0.99, 1 - 1e-4, 1 - 1e-7], dtype=torch.float64
    )
    far = 1 - 1e-14
    ends = depth.depth_icdf(torch.tensor([1e-15, far], dtype=torch.float64), log_a)
    borders = sorted({*ends.tolist(), *depth.depth_icdf(p, log_a).tolist(), 0.0, log_t})
    total = 0.0
    for low, high in itertools.pairwise(borders):
        x = (low + high) / 2 + (high - low) / 2 * NODES
        cdf = depth.depth_cdf(torch.from_numpy(x), log_a).numpy()
        total += (high - low) / 2 * np.sum(WEIGHTS * np.exp(x) * (cdf - (x >= log_t)) ** 2)
    return float(total)


def test_is_the_integral_of_the_definition(log_a: torch.Tensor) -> None:
    p = torch.tensor([1e-9, 0.1, 0.3, 0.8, 1 - 1e-6], dtype=torch.float64)
    for log_t in [*depth.depth_icdf(p, log_a).tolist(), 0.0]:
        x = torch.tensor(log_t, dtype=torch.float64)
        score = abs(math.expm1(log_t)) + (crps_beyond_distance(x, log_a) / log_a.exp()).item()
        # beyond a = 1e4, t itself has the rounding of log t near 0
        rel = 1e-8 if log_a.exp() < 2e4 else 1e-6
        assert score == pytest.approx(by_quadrature(log_t, log_a), rel=rel)


def test_mean_difference_is_that_of_the_integral(log_a: torch.Tensor) -> None:
    """E CRPS(T) = E|T - T'|/2: the law scored by itself."""
    p = torch.from_numpy((NODES + 1) / 2)
    log_t = depth.depth_icdf(p, log_a)
    score = log_t.expm1().abs() * log_a.exp() + crps_beyond_distance(log_t, log_a)
    own = score @ torch.from_numpy(WEIGHTS) / 2
    assert half_mean_difference(log_a).item() == pytest.approx(own.item(), rel=0.002)


def test_large_precisions_are_laplace_and_small_ones_exponential() -> None:
    """Half the mean difference of Laplace's law is 3/4 of its scale, of the exponential law 1/2."""
    ends = torch.tensor([1e-8, 1e8], dtype=torch.float64).log()
    torch.testing.assert_close(half_mean_difference(ends), torch.tensor([0.5, 0.75]).double(), rtol=1e-6, atol=0)


def test_derivatives_in_both_arguments(log_a: torch.Tensor) -> None:
    log_t = depth.depth_icdf(torch.tensor([0.05, 0.4, 0.9], dtype=torch.float64), log_a)
    width = log_t.abs().max().item()  # steps are to be small beside it

    def score(x: torch.Tensor, log_a: torch.Tensor) -> torch.Tensor:
        return crps_beyond_distance(width * x, log_a)

    assert gradcheck(score, ((log_t / width).requires_grad_(), log_a.expand(3).clone().requires_grad_()))


def test_slope_in_depth_is_that_of_the_definition(distribution: ProjectedHuber) -> None:
    """d CRPS(z)/dz = 2 F(z) - 1, in front of the camera and behind it."""
    p = torch.tensor([1e-6, 0.01, 0.3, 0.7, 0.999], dtype=torch.float64)
    z = torch.cat([distribution.depth_icdf(p), torch.tensor([-2.0], dtype=torch.float64)]).requires_grad_()
    (slope,) = torch.autograd.grad(distribution.depth_crps(z).sum(), z)
    torch.testing.assert_close(slope, 2 * distribution.depth_cdf(z.detach()) - 1, rtol=1e-9, atol=1e-9)


def test_is_the_score_of_samples(distribution: ProjectedHuber) -> None:
    generator = torch.Generator().manual_seed(1)
    drawn = distribution.rsample((50_000,), generator)[:, 2].sort().values
    rank = torch.arange(1, len(drawn) + 1, dtype=torch.float64)
    half_difference = ((2 * rank - len(drawn) - 1) * drawn).sum() / len(drawn) ** 2  # of all pairs, sorted
    for p in (0.01, 0.5, 0.95):
        z = distribution.depth_icdf(p)
        expected = (drawn - z).abs().mean() - half_difference
        assert distribution.depth_crps(z).item() == pytest.approx(expected.item(), rel=0.02)


def test_float32_is_near_float64(log_a: torch.Tensor) -> None:
    log_t = depth.depth_icdf(torch.tensor([0.05, 0.4, 0.9], dtype=torch.float64), log_a)
    near = crps_beyond_distance(log_t.float(), log_a.float())
    torch.testing.assert_close(near.double(), crps_beyond_distance(log_t, log_a), rtol=1e-3, atol=1e-3)

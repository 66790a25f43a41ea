"""The depth law against 30-digit arithmetic, for precisions from 1e-3 to 1e6; its score against quadrature."""

import itertools
import math

import mpmath as mp
import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

from phd_exp.distributions import ProjectedHuber, depth
from phd_exp.distributions.depth import crps_beyond_distance, half_mean_difference
from phd_exp.distributions.depth_law import Kinked
from phd_exp.distributions.special import log_scaled_normaliser

PRECISIONS = [1e-3, 0.03, 0.3, 1.0, 1.5, 10.0, 300.0, 1e4, 1e6]
# probabilities on both sides of the mode, in both tails
PROBABILITIES = torch.tensor(
    [1e-12, 1e-6, 1e-3, 0.1, 0.27, 0.3, 0.5, 0.55, 0.9, 0.999, 1 - 1e-9], dtype=torch.float64
)


def log(value: float) -> torch.Tensor:
    return torch.tensor(value, dtype=torch.float64).log()


def entropy(log_a: torch.Tensor) -> torch.Tensor:
    law = Kinked(log_a)
    return law.log_normaliser + law.mean_energy


def log_density(log_t: torch.Tensor, log_a: torch.Tensor) -> torch.Tensor:
    """Of t: -a max(t, 1/t) - log N(a)."""
    return -depth.depth_energy(log_t, log_a) - log_scaled_normaliser(log_a)


def scaled(n: int, a: mp.mpf) -> mp.mpf:
    return mp.exp(a) * mp.expint(n, a)


def exact_moments(a: float) -> tuple[float, float]:
    """Mean and variance from the raw moments M_k = E_(k+2) + E_(-k); they cancel, hence many digits."""
    with mp.workdps(60):
        a = mp.mpf(a)
        M = [scaled(k + 2, a) + scaled(-k, a) for k in range(3)]
        mean = M[1] / M[0]
        return float(mean), float(M[2] / M[0] - mean**2)


def exact_cdf(t: float, a: float) -> float:
    with mp.workdps(40):
        t, a = mp.mpf(t), mp.mpf(a)
        N = mp.exp(-a) / a + mp.expint(2, a)
        return float(t * mp.expint(2, a / t) / N if t <= 1 else 1 - mp.exp(-a * t) / a / N)


@pytest.fixture(params=PRECISIONS, ids="a={:g}".format)
def a(request: pytest.FixtureRequest) -> float:
    return request.param


def test_cdf(a: float) -> None:
    spread = 1 / (1 + a)
    for t in (1 - 0.9 * spread, 1 - 0.1 * spread, 1.0, 1 + 0.1 * spread, 1 + 3 * spread, 1 + 20 * spread):
        assert depth.depth_cdf(log(t), log(a)).item() == pytest.approx(exact_cdf(t, a), rel=1e-9, abs=1e-14)


def test_mean_of_the_inverse_depth(a: float) -> None:
    with mp.workdps(60):
        x = mp.mpf(a)
        exact = float(1 - 2 * scaled(1, x) / (scaled(2, x) + scaled(0, x)))
    assert depth.inverse_depth_shortfall(torch.tensor(a, dtype=torch.float64)).item() == pytest.approx(
        exact, rel=1e-9
    )
    single = depth.inverse_depth_shortfall(torch.tensor(a, dtype=torch.float32))
    assert single.item() == pytest.approx(exact, rel=1e-5)


def test_mean_and_variance(a: float) -> None:
    mean, variance = Kinked(log(a)).moments
    assert (mean.item(), variance.item()) == pytest.approx(exact_moments(a), rel=1e-12)
    in_float32 = Kinked(log(a).float()).moments[1]
    assert in_float32.item() == pytest.approx(variance.item(), rel=1e-5), "without cancellation"


def test_entropy_is_the_papers_formula(a: float) -> None:
    with mp.workdps(40):
        x = mp.mpf(a)
        g = x * scaled(2, x)
        log_n, slope = mp.log1p(g) - x - mp.log(x), 1 / x - 2 * (1 + 1 / x) / (1 + g)
        expected = float(log_n - x * slope)
    assert entropy(log(a)).item() == pytest.approx(expected, rel=1e-12, abs=1e-12)


def test_icdf_inverts_cdf(a: float) -> None:
    log_t = depth.depth_icdf(PROBABILITIES, log(a))
    assert (log_t.diff() > 0).all()
    # where a is large, t itself has the rounding of log t near 0; hence tolerances relative to both tails
    torch.testing.assert_close(depth.depth_cdf(log_t, log(a)), PROBABILITIES, rtol=1e-9, atol=1e-15)
    p, log_a = torch.linspace(0.01, 0.99, 99), log(a).float()
    torch.testing.assert_close(depth.depth_cdf(depth.depth_icdf(p, log_a), log_a), p, rtol=1e-4, atol=1e-5)


def test_icdf_is_differentiable(a: float) -> None:
    p = PROBABILITIES[1:-1].clone().requires_grad_()
    log_a = log(a).expand(p.shape).clone().requires_grad_()
    log_t = depth.depth_icdf(p, log_a)
    by_p, by_log_a = torch.autograd.grad(log_t.sum(), (p, log_a))
    # the implicit function theorem, with the derivative of the CDF in log a by central differences
    point, step = log_t.detach(), 1e-5
    density = (log_density(point, log_a.detach()) + point).exp()
    change = depth.depth_cdf(point, log_a.detach() + step) - depth.depth_cdf(point, log_a.detach() - step)
    torch.testing.assert_close(by_p, 1 / density, rtol=1e-8, atol=0)
    torch.testing.assert_close(by_log_a, -change / (2 * step) / density, rtol=1e-4, atol=1e-6)


def test_cdf_is_differentiable(a: float) -> None:
    """In log t its derivative is the density of log t, at the mode too."""
    log_t = (torch.tensor([-2.0, -0.1, 0.0, 0.1, 2.0], dtype=torch.float64) / (1 + a)).requires_grad_()
    (slope,) = torch.autograd.grad(depth.depth_cdf(log_t, log(a)).sum(), log_t)
    torch.testing.assert_close(slope, (log_density(log_t, log(a)) + log_t).exp())


def test_moments_and_entropy_are_differentiable(a: float) -> None:
    log_a = log(a).requires_grad_()
    assert gradcheck(lambda log_a: Kinked(log_a).moments[0], log_a)
    assert gradcheck(lambda log_a: Kinked(log_a).moments[1], log_a)
    assert gradcheck(entropy, log_a)


def test_derivatives_of_the_log_density(a: float) -> None:
    """In log t they are -+ a max(t, 1/t), and in log a mean energy minus energy, as in every exponential family."""
    log_t = (torch.tensor([-0.5, -0.01, 0.02, 0.7], dtype=torch.float64) / (1 + a)).requires_grad_()
    log_a = log(a).expand(4).clone().requires_grad_()
    by_log_t, by_log_a = torch.autograd.grad(log_density(log_t, log_a).sum(), (log_t, log_a))
    torch.testing.assert_close(by_log_t, -log_t.sign() * a * log_t.abs().exp())
    torch.testing.assert_close(by_log_a, depth.depth_mean_energy(log_a) - depth.depth_energy(log_t, log_a))


@pytest.mark.parametrize("log_a", [-1e4, -300.0, -50.0])
def test_quantiles_are_finite_where_a_underflows(log_a: float) -> None:
    p = torch.linspace(0.05, 0.95, 19, requires_grad=True)
    log_t = depth.depth_icdf(p, torch.tensor(log_a))
    (slope,) = torch.autograd.grad(log_t.sum(), p)
    # as a -> 0, P(t < 1) -> 0 and a t is exponentially distributed
    torch.testing.assert_close(log_t, (-torch.log1p(-p)).log() - log_a, rtol=1e-5, atol=1e-3)
    assert slope.isfinite().all()


SCORED = [1e-3, 0.3, 0.999, 1.0, 1.001, 30.0, 1e4, 1e6]
NODES, WEIGHTS = np.polynomial.legendre.leggauss(40)


@pytest.fixture(params=SCORED, ids="a={:g}".format)
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

"""The depth law against 30-digit arithmetic, for precisions from 1e-3 to 1e6."""

import mpmath as mp
import pytest
import torch
from torch.autograd import gradcheck

from phd_exp.distributions import depth
from phd_exp.distributions.special import log_scaled_normaliser

PRECISIONS = [1e-3, 0.03, 0.3, 1.0, 1.5, 10.0, 300.0, 1e4, 1e6]
# probabilities on both sides of the mode, in both tails
PROBABILITIES = torch.tensor(
    [1e-12, 1e-6, 1e-3, 0.1, 0.27, 0.3, 0.5, 0.55, 0.9, 0.999, 1 - 1e-9], dtype=torch.float64
)


def log(value: float) -> torch.Tensor:
    return torch.tensor(value, dtype=torch.float64).log()


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
    mean, variance = depth.depth_mean_and_variance(log(a))
    assert (mean.item(), variance.item()) == pytest.approx(exact_moments(a), rel=1e-12)
    in_float32 = depth.depth_mean_and_variance(log(a).float())[1]
    assert in_float32.item() == pytest.approx(variance.item(), rel=1e-5), "without cancellation"


def test_entropy_is_the_papers_formula(a: float) -> None:
    with mp.workdps(40):
        x = mp.mpf(a)
        g = x * scaled(2, x)
        log_n, slope = mp.log1p(g) - x - mp.log(x), 1 / x - 2 * (1 + 1 / x) / (1 + g)
        expected = float(log_n - x * slope)
    assert depth.depth_entropy(log(a)).item() == pytest.approx(expected, rel=1e-12, abs=1e-12)


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
    assert gradcheck(lambda log_a: depth.depth_mean_and_variance(log_a)[0], log_a)
    assert gradcheck(lambda log_a: depth.depth_mean_and_variance(log_a)[1], log_a)
    assert gradcheck(depth.depth_entropy, log_a)


def test_derivatives_of_the_log_density(a: float) -> None:
    """In log t they are -+ a max(t, 1/t), and in log a mean energy minus energy, as in every exponential family."""
    log_t = (torch.tensor([-0.5, -0.01, 0.02, 0.7], dtype=torch.float64) / (1 + a)).requires_grad_()
    log_a = log(a).expand(4).clone().requires_grad_()
    by_log_t, by_log_a = torch.autograd.grad(log_density(log_t, log_a).sum(), (log_t, log_a))
    mean_energy = depth.depth_entropy(log_a) - log_scaled_normaliser(log_a)
    torch.testing.assert_close(by_log_t, -log_t.sign() * a * log_t.abs().exp())
    torch.testing.assert_close(by_log_a, mean_energy - depth.depth_energy(log_t, log_a))


@pytest.mark.parametrize("log_a", [-1e4, -300.0, -50.0])
def test_quantiles_are_finite_where_a_underflows(log_a: float) -> None:
    p = torch.linspace(0.05, 0.95, 19, requires_grad=True)
    log_t = depth.depth_icdf(p, torch.tensor(log_a))
    (slope,) = torch.autograd.grad(log_t.sum(), p)
    # as a -> 0, P(t < 1) -> 0 and a t is exponentially distributed
    torch.testing.assert_close(log_t, (-torch.log1p(-p)).log() - log_a, rtol=1e-5, atol=1e-3)
    assert slope.isfinite().all()

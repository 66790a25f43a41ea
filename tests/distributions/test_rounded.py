"""The law of depth with a rounded mode against 25-digit arithmetic."""

import math

import mpmath as mp
import pytest
import torch
from torch.autograd import gradcheck

from phd_exp.distributions.depth_law import Kinked
from phd_exp.distributions.rounded import Rounded

LAWS = [(1e-3, 2.0), (0.3, 0.5), (1.0, 2.0), (2.0, 2.0), (30.0, 2.0), (1e4, 0.5)]
PROBABILITIES = torch.tensor([1e-12, 1e-6, 1e-3, 0.1, 0.45, 0.5, 0.55, 0.9, 0.999, 1 - 1e-9], dtype=torch.float64)


class Exact:
    """The law by adaptive quadrature."""

    def __init__(self, a: float, r: float) -> None:
        self.a, self.r = mp.mpf(a), mp.mpf(r)
        far = [mp.mpf(k) / self.a for k in (0.3, 1, 3, 8, 20, 60)]
        self.breaks = [mp.mpf(0), *(1 / (1 + x) for x in reversed(far)), mp.mpf(1), *(1 + x for x in far)]
        self.mass = self.integral(lambda t: 1)

    def energy(self, t: mp.mpf) -> mp.mpf:
        sinh, cosh = (t - 1 / t) / 2, (t + 1 / t) / 2
        return self.a * (cosh - 1) + mp.sqrt((self.a * sinh) ** 2 + self.r**2) - self.r

    def integral(self, function, end: mp.mpf = mp.inf) -> mp.mpf:
        breaks = [t for t in self.breaks if t < end]
        breaks = breaks if end == mp.inf else [*breaks, end]
        return mp.quad(lambda t: function(t) * mp.exp(-self.energy(t)) if t > 0 else mp.mpf(0), breaks)

    def mean(self, function) -> float:
        return float(self.integral(function) / self.mass)


@pytest.fixture(scope="module", params=LAWS, ids=lambda law: "a={:g},r={:g}".format(*law))
def law(request: pytest.FixtureRequest) -> Rounded:
    a, r = request.param
    return Rounded(torch.tensor(a, dtype=torch.float64).log(), r)


@pytest.fixture(scope="module")
def exact(law: Rounded) -> Exact:
    with mp.workdps(25):
        return Exact(float(law.log_a.exp()), law.r)


def test_normaliser_and_moments(law: Rounded, exact: Exact) -> None:
    a = exact.a
    with mp.workdps(25):
        mean, inverse = exact.mean(lambda t: a * (t - 1)), exact.mean(lambda t: 1 - 1 / t)
        expected = [
            float(mp.log(exact.mass)),
            mean,
            exact.mean(lambda t: (a * (t - 1) - mean) ** 2),
            inverse,
            exact.mean(lambda t: (1 - 1 / t - inverse) ** 2),
            exact.mean(exact.energy),
        ]
    found = law.log_normaliser, *law.excess_moments, *law.inverse_moments, law.mean_energy
    assert [value.item() for value in found] == pytest.approx(expected, rel=1e-8)
    single = Rounded(law.log_a.float(), law.r)
    found = single.log_normaliser, *single.excess_moments, *single.inverse_moments, single.mean_energy
    # means of terms of both signs, whose sum is about 1/a of each
    assert [value.item() for value in found] == pytest.approx(expected, rel=1e-5 + 1e-7 * float(a))


def test_cdf(law: Rounded, exact: Exact) -> None:
    for s in (-3.0, -0.2, 0.4, 5.0):
        log_t = math.copysign(math.log1p(abs(s) / float(exact.a)), s)
        with mp.workdps(25):
            below = float(exact.integral(lambda u: 1, mp.exp(log_t)) / exact.mass)
        assert law.cdf(torch.tensor(log_t, dtype=torch.float64)).item() == pytest.approx(below, rel=1e-7)


@pytest.mark.parametrize("r", [2.0, 10.0])
@pytest.mark.parametrize("a", [1e-5, 1e-3, 1.0, 1e6])
def test_levels_are_exact_to_1e_7(a: float, r: float) -> None:
    """P(h(|q|) + energy <= W) with the density r exp(-h(r)) of |q|, and with l = log t, of which both signs count."""
    law, W = Rounded(torch.tensor(a, dtype=torch.float64).log(), r), torch.tensor([0.4, 3.0, 20.0]).double()
    with mp.workdps(20):
        a, r = mp.mpf(a), mp.mpf(r)

        def energy(l: mp.mpf) -> mp.mpf:
            return a * (mp.cosh(l) - 1) + mp.sqrt((a * mp.sinh(l)) ** 2 + r**2) - r

        def end(w: float) -> mp.mpf:
            return mp.acosh(1 + w * (w + 2 * r) / (2 * a * (a + r + w)))

        def projected(w: mp.mpf) -> mp.mpf:
            q = mp.sqrt(2 * w) if w <= 0.5 else w + 0.5
            inner = 1 - mp.exp(-(min(q, 1) ** 2) / 2)
            return inner + (mp.sqrt(mp.e) * (2 / mp.e - (1 + q) * mp.exp(-q)) if q > 1 else 0)

        def integral(function, most: float, *breaks: float) -> mp.mpf:
            ends = [0, *(end(w) for w in sorted({*breaks, *(most * share for share in (1e-3, 0.03, 0.3, 1))}))]
            return mp.quad(lambda l: (mp.exp(l) + mp.exp(-l)) * mp.exp(-energy(l)) * function(energy(l)), ends)

        mass = integral(lambda w: 1, 60, 1, 5) * (1 + mp.exp(-0.5))
        for w, level in zip(W.tolist(), law.level(W).tolist(), strict=True):
            knee = [w - 0.5] if w > 0.5 else []
            expected = integral(lambda v, w=w: projected(max(w - v, mp.mpf(0))), w, *knee) / mass
            assert abs(level - float(expected)) < 1e-7


def test_score_is_the_integral_of_squared_differences(law: Rounded) -> None:
    a = law.log_a.exp()
    log_t = law.icdf(torch.tensor([0.02, 0.5, 0.9], dtype=torch.float64))
    grid = law.icdf(torch.sigmoid(torch.linspace(-25, 25, 20_001, dtype=torch.float64)))
    below, u = law.cdf(grid), grid.exp()
    for at, score in zip(log_t, law.crps_beyond_distance(log_t), strict=True):
        squared = (below - (grid >= at).double()).square()
        expected = a * torch.trapezoid(squared, u) - a * (at.exp() - 1).abs()
        torch.testing.assert_close(score, expected, rtol=1e-3, atol=1e-3)


def test_icdf_inverts_cdf(law: Rounded) -> None:
    log_t = law.icdf(PROBABILITIES)
    assert (log_t.diff() > 0).all()
    torch.testing.assert_close(law.cdf(log_t), PROBABILITIES, rtol=1e-9, atol=1e-15)
    assert law.icdf(torch.tensor([0.0, 1.0]).double()).tolist() == [-math.inf, math.inf]


def test_everything_is_differentiable(law: Rounded) -> None:
    p, log_a = PROBABILITIES[2:-2], law.log_a.clone().requires_grad_()
    for function in (
        lambda log_a: Rounded(log_a, law.r).log_normaliser,
        lambda log_a: Rounded(log_a, law.r).moments[1],
        lambda log_a: Rounded(log_a, law.r).icdf(p),
        lambda log_a: Rounded(log_a, law.r).energy(law.icdf(p).detach()),
    ):
        assert gradcheck(function, log_a)


def test_slopes_are_derivatives_by_log_a(law: Rounded) -> None:
    log_t, log_a = law.icdf(PROBABILITIES[1:-1]), law.log_a.clone().requires_grad_()
    at = Rounded(log_a, law.r)
    for energy, slope in zip(at.energy(log_t), law.slope(log_t), strict=True):
        torch.testing.assert_close(torch.autograd.grad(energy, log_a, retain_graph=True)[0], slope)
    torch.testing.assert_close(torch.autograd.grad(at.log_normaliser, log_a)[0], -law.mean_slope)


def test_the_farthest_depth_has_the_energy(law: Rounded) -> None:
    energy = torch.tensor([1e-9, 0.1, 1.0, 30.0], dtype=torch.float64)
    log_t = law.farthest_log_t(energy)
    for side in (log_t, -log_t):
        torch.testing.assert_close(law.energy(side), energy)


def test_a_depth_at_the_mode_has_its_closest_law(law: Rounded) -> None:
    width = 1 / law.log_a.exp().clamp_min(1)
    log_t = width[..., None] * torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)
    assert all(value.isfinite().all() for value in law.closest_to(log_t, torch.full_like(log_t, 1 / 3)))


@pytest.mark.parametrize("a", [1e-3, 0.5, 3.0, 200.0])
def test_a_small_rounding_leaves_the_law_of_the_paper(a: float) -> None:
    log_a = torch.tensor(a, dtype=torch.float64).log()
    rounded, kinked = Rounded(log_a, 1e-4), Kinked(log_a)
    W, log_t = torch.tensor([0.2, 1.0, 4.0]).double(), torch.tensor([-0.4, -0.01, 0.02, 1.0]).double()
    for one, other in (
        (rounded.log_normaliser, kinked.log_normaliser),
        (rounded.level(W), kinked.level(W)),
        (rounded.cdf(log_t), kinked.cdf(log_t)),
        (rounded.crps_beyond_distance(log_t), kinked.crps_beyond_distance(log_t)),
        (rounded.mean_energy, kinked.mean_energy),
        (rounded.moments[1], kinked.moments[1]),
    ):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-3)

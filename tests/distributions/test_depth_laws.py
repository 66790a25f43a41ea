"""The laws of depth, the paper's and those with a rounded mode, against 25-digit arithmetic and quadrature."""

import itertools
import math

import mpmath as mp
import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

from phd_exp.distributions.depth_law import DepthLaw
from phd_exp.distributions.kinked import Kinked
from phd_exp.distributions.rounded import Rounded, depth_law

LAWS = [(a, 0.0) for a in (1e-3, 0.3, 0.999, 1.0, 1.5, 30.0, 1e4, 1e6)]  # formulas change at a = 1
LAWS += [(1e-3, 2.0), (0.3, 0.5), (1.0, 2.0), (2.0, 10.0), (30.0, 2.0), (1e4, 0.5)]
PROBABILITIES = torch.tensor([1e-12, 1e-6, 1e-3, 0.1, 0.27, 0.3, 0.45, 0.5, 0.55, 0.9, 0.999, 1 - 1e-9]).double()
PROBABILITIES[-1] = 1 - 1e-9
NODES, WEIGHTS = np.polynomial.legendre.leggauss(40)
ENERGIES = torch.tensor([1e-3, 0.4, 0.5, 0.51, 3.0, 20.0], dtype=torch.float64)


class Exact:
    """The law by adaptive quadrature; a rounding of 0 is the paper's."""

    def __init__(self, a: float, r: float) -> None:
        self.a, self.r = mp.mpf(a), mp.mpf(r)
        far = [mp.mpf(k) / self.a for k in (0.3, 1, 3, 8, 20, 60)]
        self.breaks = [mp.mpf(0), *(1 / (1 + x) for x in reversed(far)), mp.mpf(1), *(1 + x for x in far)]
        self.mass = self.integral(lambda t: 1)

    def energy(self, t: mp.mpf) -> mp.mpf:
        sinh, cosh = (t - 1 / t) / 2, (t + 1 / t) / 2
        return self.a * (cosh - 1) + mp.sqrt((self.a * sinh) ** 2 + self.r**2) - self.r

    def farthest(self, w: mp.mpf) -> mp.mpf:
        return mp.acosh(1 + w * (w + 2 * self.r) / (2 * self.a * (self.a + self.r + w)))

    def integral(self, function, end: mp.mpf = mp.inf) -> mp.mpf:
        breaks = [t for t in self.breaks if t < end]
        breaks = breaks if end == mp.inf else [*breaks, end]
        return mp.quad(lambda t: function(t) * mp.exp(-self.energy(t)) if t > 0 else mp.mpf(0), breaks)

    def mean(self, function) -> float:
        return float(self.integral(function) / self.mass)

    def level(self, W: float) -> float:
        """P(h(|q|) + energy <= W) with the density r exp(-h(r)) of |q|; both signs of l = log t count."""

        def projected(w: mp.mpf) -> mp.mpf:
            q = mp.sqrt(2 * w) if w <= 0.5 else w + 0.5
            inner = 1 - mp.exp(-(min(q, 1) ** 2) / 2)
            return inner + (mp.sqrt(mp.e) * (2 / mp.e - (1 + q) * mp.exp(-q)) if q > 1 else 0)

        def inside(l: mp.mpf) -> mp.mpf:
            w = self.energy(mp.exp(l))
            return (mp.exp(l) + mp.exp(-l)) * mp.exp(-w) * projected(max(W - w, mp.mpf(0)))

        knee = [W - 0.5] if W > 0.5 else []
        ends = [
            0,
            *(self.farthest(mp.mpf(w)) for w in sorted({*knee, *(W * share for share in (1e-3, 0.03, 0.3, 1))})),
        ]
        return float(mp.quad(inside, ends) / (self.mass * (1 + mp.exp(-0.5))))


def law_of(a: float, r: float, dtype: torch.dtype = torch.float64) -> DepthLaw:
    return depth_law(torch.tensor(a, dtype=torch.float64).log().to(dtype), r)


@pytest.fixture(scope="module", params=LAWS, ids=lambda law: "a={:g},r={:g}".format(*law))
def law(request: pytest.FixtureRequest) -> DepthLaw:
    return law_of(*request.param)


@pytest.fixture(scope="module")
def exact(law: DepthLaw) -> Exact:
    with mp.workdps(25):
        return Exact(float(law.log_a.exp()), getattr(law, "r", 0.0))


def statistics(law: DepthLaw) -> list[float]:
    found = law.log_normaliser, *law.excess_moments, *law.inverse_moments, law.mean_energy
    return [value.item() for value in found]


def test_normaliser_and_moments(law: DepthLaw, exact: Exact) -> None:
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
    assert statistics(law) == pytest.approx(expected, rel=1e-8)
    # means of terms of both signs, whose sum is about 1/a of each
    near = 1e-5 + (1e-7 * float(a) if exact.r else 0)
    assert statistics(law_of(float(a), float(exact.r), torch.float32)) == pytest.approx(expected, rel=near)
    assert [value.item() for value in law.moments] == pytest.approx([1 + mean / a, expected[2] / a**2], rel=1e-7)


def test_cdf_and_level(law: DepthLaw, exact: Exact) -> None:
    for s in (-3.0, -0.2, 0.4, 5.0):
        log_t = math.copysign(math.log1p(abs(s) / float(exact.a)), s)
        with mp.workdps(25):
            below = float(exact.integral(lambda u: 1, mp.exp(log_t)) / exact.mass)
        assert law.cdf(torch.tensor(log_t, dtype=torch.float64)).item() == pytest.approx(below, rel=1e-7)
    with mp.workdps(20):
        assert law.level(ENERGIES).tolist() == pytest.approx([exact.level(w) for w in ENERGIES.tolist()], abs=1e-7)


def test_icdf_inverts_cdf(law: DepthLaw) -> None:
    log_t = law.icdf(PROBABILITIES)
    assert (log_t.diff() > 0).all()
    # where a is large, t itself has the rounding of log t near 0; hence tolerances relative to both tails
    torch.testing.assert_close(law.cdf(log_t), PROBABILITIES, rtol=1e-9, atol=1e-15)
    assert law.icdf(torch.tensor([0.0, 1.0]).double()).tolist() == [-math.inf, math.inf]
    p, single = torch.linspace(0.01, 0.99, 99), law_of(float(law.log_a.exp()), getattr(law, "r", 0.0), torch.float32)
    torch.testing.assert_close(single.cdf(single.icdf(p)), p, rtol=1e-4, atol=1e-5)


def test_everything_is_differentiable(law: DepthLaw) -> None:
    """The derivative of the CDF in log t is the density of log t, that of the quantile in p its inverse."""
    p, r = PROBABILITIES[2:-2].clone().requires_grad_(), getattr(law, "r", 0.0)
    log_t = law.icdf(p)
    density = (log_t - law.energy(log_t) - law.log_normaliser).exp().detach()
    torch.testing.assert_close(torch.autograd.grad(log_t.sum(), p)[0], 1 / density, rtol=2e-5 if r else 1e-8, atol=0)
    log_t = torch.cat([log_t.detach(), torch.zeros(1).double()]).requires_grad_()
    at_mode = torch.cat([density, (-law.log_normaliser).exp()[None]])
    torch.testing.assert_close(
        torch.autograd.grad(law.cdf(log_t).sum(), log_t)[0], at_mode, rtol=2e-5 if r else 1e-8, atol=0
    )
    log_t, p, log_a = log_t.detach()[:-1], p.detach(), law.log_a.clone().requires_grad_()
    for function in (
        lambda log_a: depth_law(log_a, r).log_normaliser,
        lambda log_a: torch.stack(depth_law(log_a, r).excess_moments),
        lambda log_a: depth_law(log_a, r).mean_energy,
        lambda log_a: depth_law(log_a, r).icdf(p),
        lambda log_a: depth_law(log_a, r).energy(log_t),
        *([] if r else [lambda log_a: depth_law(log_a, r).crps_beyond_distance(log_t)]),
    ):
        assert gradcheck(function, log_a, rtol=1e-3, atol=1e-4)


def test_the_farthest_depth_has_the_energy(law: DepthLaw) -> None:
    energy = torch.tensor([1e-9, 0.1, 1.0, 30.0], dtype=torch.float64)
    for side in (1, -1):
        torch.testing.assert_close(law.energy(side * law.farthest_log_t(energy)), energy, rtol=1e-6, atol=1e-12)


def score_by_quadrature(law: DepthLaw, log_t: float) -> float:
    """int (F(u) - 1[u >= t])^2 du in u = e^x, between borders around which F changes."""
    p = torch.tensor([1e-15, 1e-12, 1e-9, 1e-6, 1e-4, 0.01, 0.1, 0.3, 0.6, 0.9, 0.99, 1 - 1e-4]).double()
    p = torch.cat([p, 1 - torch.tensor([1e-7, 1e-14], dtype=torch.float64)])
    total = 0.0
    for low, high in itertools.pairwise(sorted({*law.icdf(p).tolist(), 0.0, log_t})):
        x = (low + high) / 2 + (high - low) / 2 * NODES
        squared = (law.cdf(torch.from_numpy(x)).numpy() - (x >= log_t)) ** 2
        total += (high - low) / 2 * np.sum(WEIGHTS * np.exp(x) * squared)
    return float(total)


def test_score_is_the_integral_of_squared_differences(law: DepthLaw) -> None:
    a = law.log_a.exp()
    points = law.icdf(torch.tensor([1e-9, 0.1, 0.3, 0.8, 1 - 1e-6], dtype=torch.float64))
    for log_t in [*points.tolist(), 0.0]:
        beyond = law.crps_beyond_distance(torch.tensor(log_t, dtype=torch.float64))
        score = abs(math.expm1(log_t)) + (beyond / a).item()
        # beyond a = 1e4, t itself has the rounding of log t near 0
        assert score == pytest.approx(score_by_quadrature(law, log_t), rel=1e-8 if a < 2e4 else 1e-6)
    single = law_of(float(a), getattr(law, "r", 0.0), torch.float32)
    ours, theirs = single.crps_beyond_distance(points.float()).double(), law.crps_beyond_distance(points)
    torch.testing.assert_close(ours[1:-1], theirs[1:-1], rtol=1e-3, atol=1e-3)


def test_large_precisions_are_laplace_and_small_ones_exponential() -> None:
    """Half the mean difference of Laplace's law is 3/4 of its scale, of the exponential law 1/2."""
    ends = Kinked(torch.tensor([1e-8, 1e8], dtype=torch.float64).log()).half_mean_difference
    torch.testing.assert_close(ends, torch.tensor([0.5, 0.75]).double(), rtol=1e-6, atol=0)


@pytest.mark.parametrize("log_a", [-1e4, -300.0, -50.0])
def test_quantiles_are_finite_where_a_underflows(log_a: float) -> None:
    """As a -> 0, P(t < 1) -> 0 and a t is exponentially distributed."""
    p = torch.linspace(0.05, 0.95, 19, requires_grad=True)
    log_t = Kinked(torch.tensor(log_a)).icdf(p)
    torch.testing.assert_close(log_t, (-torch.log1p(-p)).log() - log_a, rtol=1e-5, atol=1e-3)
    assert torch.autograd.grad(log_t.sum(), p)[0].isfinite().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("a", [0.0, 1e-4, 0.7, 1.0, 4.0, 1e6])
def test_levels_grow_from_zero_to_one_in_float32_as_in_float64(a: float, dtype: torch.dtype) -> None:
    W = torch.cat([torch.zeros(1, dtype=dtype), torch.logspace(-2, 6, 400, dtype=dtype), torch.tensor([math.inf])])
    level, exact = (law_of(a, 0.0, one).level(W.to(one)) for one in (dtype, torch.float64))
    torch.testing.assert_close(level.double(), exact, rtol=0, atol=2e-6)
    assert (level.diff() >= -4 * torch.finfo(dtype).eps).all()
    assert level[0] <= 4 * torch.finfo(dtype).eps
    assert level[-2:].tolist() == [1, 1]


def test_a_depth_at_the_mode_has_its_closest_law() -> None:
    for a, r in LAWS:
        if r:
            law, width = law_of(a, r), 1 / max(a, 1)
            log_t = width * torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)
            assert isinstance(law, Rounded)
            assert all(value.isfinite().all() for value in law.closest_to(log_t, torch.full_like(log_t, 1 / 3)))


@pytest.mark.parametrize("a", [1e-3, 0.5, 3.0, 200.0])
def test_a_small_rounding_leaves_the_law_of_the_paper(a: float) -> None:
    W, log_t = torch.tensor([0.2, 1.0, 4.0]).double(), torch.tensor([-0.4, -0.01, 0.02, 1.0]).double()
    for name, arguments in (
        ("energy", [log_t]), ("level", [W]), ("cdf", [log_t]), ("crps_beyond_distance", [log_t]),
    ):  # fmt: skip
        rounded, kinked = (getattr(law_of(a, r), name)(*arguments) for r in (1e-4, 0.0))
        torch.testing.assert_close(rounded, kinked, rtol=1e-3, atol=1e-3)

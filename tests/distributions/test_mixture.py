"""The laws of a mixture of Projected Huber distributions, and of the single distribution closest to it."""

import math

import numpy as np
import pytest
import torch
from scipy import optimize, stats
from torch.distributions import MultivariateNormal, kl_divergence

from phd_exp.distributions import Mixture, ProjectedHuber
from tests.distributions.conftest import INSTANCES, MU_Z0, F, S

TRAINED = (20.0, -45.0, 90.0, 15.0, 120.0, 60.0, 4.0, 1.2, -0.5)


def ensemble(spread: float, members: int, batch: tuple[int, ...] = (), seed: int = 0, numbers: int = 7) -> Mixture:
    """Trained networks that disagree by about `spread` standard deviations."""
    draw = torch.Generator().manual_seed(seed)
    noise = torch.randn((*batch, members, numbers), generator=draw, dtype=torch.float64)
    scale = torch.tensor([1.0, 1, 10, 10, 10, 6, 1, 0.3, 0.3], dtype=torch.float64)
    raw = torch.tensor(TRAINED[:numbers], dtype=torch.float64) + spread * scale[:numbers] * noise
    return Mixture(ProjectedHuber.from_raw(raw, f=F, S=S, mu_z0=MU_Z0))


def single(p: ProjectedHuber, members: int) -> Mixture:
    return Mixture(p.expand((members,)))


APART = [(20.0, -45.0, 90.0, 15.0, 120.0, 60.0, 4.0), (25.0, -45.0, 90.0, 0.0, 100.0, 80.0, -15.0)]
MIXTURES = {
    "agreeing": ensemble(0.3, 5),
    "disagreeing": ensemble(2.0, 8),
    "with free axes": ensemble(1.0, 5, numbers=9),
    "apart": Mixture(ProjectedHuber.from_raw(torch.tensor(APART, dtype=torch.float64), f=F, S=S, mu_z0=MU_Z0)),
}
WIDE = [
    (-16.0, -45, 70, 20, 90, 2.0, -4, 2, -1),
    (50, -20, 120, 0, 150, 5, 6, -2, 1),
    (20, -90, 60, 15, 120, 1, 0, 0, 2),
]
MIXTURES |= {
    f"wide in depth{axes}": Mixture(
        ProjectedHuber.from_raw(torch.tensor(WIDE)[:, :n].double(), f=F, S=S, mu_z0=MU_Z0)
    )
    for n, axes in ((7, ""), (9, ", with free axes"))
}
MIXTURES |= {
    f"{name}, rounded": Mixture(MIXTURES[name].members.with_rounding(2.0)) for name in ("with free axes", "apart")
}
every_mixture = pytest.mark.parametrize("mixture", MIXTURES.values(), ids=MIXTURES.keys())


@pytest.fixture(scope="module")
def drawn() -> dict[str, torch.Tensor]:
    return {name: mixture.rsample((20_000,), torch.Generator().manual_seed(1)) for name, mixture in MIXTURES.items()}


@every_mixture
def test_the_density_is_the_mean_of_the_members_and_integrates_to_one(mixture: Mixture) -> None:
    """By importance sampling from a wider distribution, which covers all members."""
    wide = mixture.members.tempered(1.5, 1.5)
    v = wide.rsample((20_000,), torch.Generator().manual_seed(0)).flatten(0, 1)
    weight = mixture.log_prob(v).exp() / wide.log_prob(v[:, None]).exp().mean(-1)
    assert abs(float(weight.mean()) - 1) < 5 * float(weight.std()) / math.sqrt(len(v)) < 0.05
    members = mixture.members.log_prob(v[:5, None])
    torch.testing.assert_close(mixture.log_prob(v[:5]).exp(), members.exp().mean(-1))


@pytest.mark.parametrize("name", MIXTURES)
def test_moments_and_depth_law_are_those_of_samples(name: str, drawn: dict[str, torch.Tensor]) -> None:
    mixture, v = MIXTURES[name], drawn[name]
    error = (mixture.covariance_matrix.diagonal() / len(v)).sqrt()
    assert bool(((v.mean(0) - mixture.mean).abs() < 5 * error).all())
    deviation = mixture.covariance_matrix.diagonal().sqrt()
    apart = (v.T.cov() - mixture.covariance_matrix) / deviation / deviation[:, None]
    assert float(apart.abs().max()) < 0.1
    for p in (0.05, 0.5, 0.9):
        z = mixture.depth_icdf(p)
        assert abs(float(mixture.depth_cdf(z)) - p) < 1e-9
        assert abs(float((v[:, 2] <= z).double().mean()) - p) < 5 * math.sqrt(p * (1 - p) / len(v))


def test_levels_of_its_own_samples_are_uniform(drawn: dict[str, torch.Tensor]) -> None:
    n = 60
    v, members = drawn["agreeing"][:n], MIXTURES["agreeing"].members
    mixture = Mixture(members.expand((n, *members.batch_shape)))
    assert stats.kstest(mixture.level(v).numpy(), "uniform").pvalue > 0.01
    mixture = Mixture(members.expand((1, *members.batch_shape)))
    assert torch.equal(mixture.level(v[:1]), mixture.level(v[:1]))  # the same draws


def test_one_member_or_equal_members_are_that_distribution(distribution: ProjectedHuber) -> None:
    v = distribution.rsample((50,), torch.Generator().manual_seed(0))
    for members in (1, 4):
        mixture, closest = single(distribution, members), single(distribution, members).closest
        torch.testing.assert_close(mixture.log_prob(v), distribution.log_prob(v))
        torch.testing.assert_close(mixture.mean, distribution.mean)
        torch.testing.assert_close(mixture.covariance_matrix, distribution.covariance_matrix)
        torch.testing.assert_close(mixture.depth_icdf(0.3), distribution.depth_icdf(0.3))
        torch.testing.assert_close(closest.mode, distribution.mode, rtol=1e-5, atol=1e-8)
        torch.testing.assert_close(closest.A, distribution.A, rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(closest.a, distribution.a, rtol=1e-4, atol=0)
        torch.testing.assert_close(closest.k, distribution.k, rtol=1e-4, atol=1e-4)
        assert abs(float(mixture.disagreement)) < 1e-6


@pytest.mark.parametrize("instance", ["generic raw", "trained network"])
def test_its_levels_are_exact_within_the_stated_error(instance: str) -> None:
    p = INSTANCES[instance].expand((30,))
    v = p.rsample((), torch.Generator().manual_seed(3))
    error = Mixture(INSTANCES[instance].expand((30, 1))).level(v) - p.level(v)
    assert float(error.square().mean().sqrt()) < 0.005


@every_mixture
def test_behind_the_camera_there_is_nothing(mixture: Mixture) -> None:
    behind = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    assert (float(mixture.log_prob(behind)), float(mixture.level(behind))) == (-math.inf, 1.0)
    assert float(mixture.depth_cdf(behind[2])) == 0


@pytest.mark.parametrize("name", MIXTURES)
def test_no_distribution_is_closer_than_the_closest(name: str, drawn: dict[str, torch.Tensor]) -> None:
    """Against a general optimiser of all numbers on samples, which starts there; n samples give 7/(2 n) nats."""
    v, p = drawn[name], MIXTURES[name].closest
    L, k = torch.linalg.cholesky(p.A), p.k

    def loss(x: np.ndarray) -> tuple[float, np.ndarray]:
        leaf = torch.tensor(x, requires_grad=True)
        factor = L @ torch.eye(2).double().index_put(
            (torch.tensor([0, 1, 1]), torch.tensor([0, 0, 1])), leaf[:3], True
        )
        mu_xy, mu_z, a = p.mu_xy + torch.linalg.solve(p.A, leaf[3:5]), p.mu_z * leaf[5].exp(), p.a * leaf[6].exp()
        axis = None if k is None else k + leaf[7:]
        q = ProjectedHuber(mu_xy, mu_z, factor @ factor.mT, a, axis, False, p.rounding)
        value = -q.log_prob(v).mean()
        value.backward()
        return value.item(), leaf.grad.numpy()

    best = optimize.minimize(loss, np.zeros(7 if k is None else 9), jac=True, method="BFGS")
    ours = -p.log_prob(v).mean()
    assert -1e-9 < float(ours) - best.fun < (3e-3 if "wide" in name else 1e-3)
    worse = [p.tempered(*t) for t in ((1.1, 1.0), (0.9, 1.0), (1.0, 1.1), (1.0, 0.9))]
    assert all(-q.log_prob(v).mean() > ours for q in worse)


@pytest.mark.parametrize("rounding", [0.0, 2.0])
@pytest.mark.parametrize("apart", [1e-4, 0.01, 2.0])
def test_the_closest_distribution_of_sharp_members_is_found(apart: float, rounding: float) -> None:
    """It may be far wider than they are."""
    mu_z = 3 * (1 + apart * torch.tensor([0.0, 1.0, 1.0], dtype=torch.float64))
    A, a = 300 * torch.eye(2).double().expand(3, 2, 2), torch.full_like(mu_z, 1e5)
    mixture = Mixture(ProjectedHuber(torch.zeros(3, 2).double(), mu_z, A, a, rounding=rounding))
    v = mixture.rsample((4_000,), torch.Generator().manual_seed(0))
    ours = mixture.closest.log_prob(v).mean()
    assert all(mixture.closest.tempered(1.0, t).log_prob(v).mean() < ours for t in (0.8, 1.25))


def test_a_batch_is_treated_row_by_row() -> None:
    mixture = ensemble(2.0, 4, batch=(3, 2))
    one = Mixture(mixture.members[2][1])
    for name in ("mean", "covariance_matrix", "disagreement"):
        torch.testing.assert_close(getattr(mixture, name)[2, 1], getattr(one, name))
    torch.testing.assert_close(mixture.closest[2][1].covariance_matrix, one.closest.covariance_matrix)


def test_disagreement_is_the_mean_divergence_of_gaussians() -> None:
    """Against torch's KL divergence, of members from the Gaussian with the mixture's moments; it grows."""
    found = [ensemble(spread, 6) for spread in (0.1, 1.0, 4.0)]
    for mixture in found:
        whole = MultivariateNormal(mixture.mean, mixture.covariance_matrix)
        parts = MultivariateNormal(mixture.members.mean, mixture.members.covariance_matrix)
        expected = kl_divergence(parts, whole.expand((6,))).mean()
        torch.testing.assert_close(mixture.disagreement, expected, rtol=1e-6, atol=1e-8)
    assert sorted(found, key=lambda mixture: float(mixture.disagreement)) == found

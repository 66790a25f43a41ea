"""The mixture of an ensemble, and the single distribution closest to it; test_laws.py has what all densities obey."""

import math

import numpy as np
import pytest
import torch
from scipy import optimize
from torch.distributions import MultivariateNormal, kl_divergence

from phd_exp.distributions import Mixture, ProjectedHuber
from tests.distributions.test_laws import samples
from tests.support.densities import INSTANCES, MIXTURES, ensemble


def single(p: ProjectedHuber, members: int) -> Mixture:
    return Mixture(p.expand((members,)))


every_mixture = pytest.mark.parametrize("mixture", MIXTURES.values(), ids=MIXTURES.keys())


@every_mixture
def test_the_density_is_the_mean_of_the_members_and_integrates_to_one(mixture: Mixture) -> None:
    """By importance sampling from a wider distribution, which covers all members."""
    wide = mixture.members.tempered(1.5, 1.5)
    v = wide.rsample((20_000,), torch.Generator().manual_seed(0)).flatten(0, 1)
    weight = mixture.log_prob(v).exp() / wide.log_prob(v[:, None]).exp().mean(-1)
    assert abs(float(weight.mean()) - 1) < 5 * float(weight.std()) / math.sqrt(len(v)) < 0.05
    members = mixture.members.log_prob(v[:5, None])
    torch.testing.assert_close(mixture.log_prob(v[:5]).exp(), members.exp().mean(-1))


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


@pytest.mark.parametrize("name", MIXTURES)
def test_no_distribution_is_closer_than_the_closest(name: str) -> None:
    """Against a general optimiser of all numbers on samples, which starts there; n samples give 7/(2 n) nats."""
    v, p = samples(name), MIXTURES[name].closest
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
    assert -1e-9 < float(ours) - best.fun < (3e-3 if "unsure" in name else 1e-3)
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

"""The density with a free axis: exactly the paper's where k = 0, and against 30-digit arithmetic elsewhere."""

import mpmath as mp
import pytest
import torch

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.columns import distribution_columns, from_columns, parameter_columns
from tests.distributions.conftest import FREE, INSTANCES
from tests.distributions.test_projected_huber import VALUES

PAPERS = {name: one for name, one in INSTANCES.items() if one.k is None}
every_free_axis = pytest.mark.parametrize("free", FREE.values(), ids=FREE)


@pytest.mark.parametrize("paper", PAPERS.values(), ids=PAPERS)
def test_without_tilt_every_value_is_the_papers_to_the_last_bit(paper: ProjectedHuber) -> None:
    free = ProjectedHuber(**paper.parameters, k=torch.zeros(2, dtype=torch.float64))
    paper = ProjectedHuber(**paper.parameters)
    xyz = paper.rsample((200,), torch.Generator().manual_seed(0))
    for name, value in VALUES.items():
        assert torch.equal(value(free, xyz), value(paper, xyz)), name


def test_without_tilt_raw_numbers_give_the_papers_loss_and_gradient_to_the_last_bit() -> None:
    raw = 3 * torch.randn(500, 7, generator=torch.Generator().manual_seed(0))
    xyz = torch.tensor([0.12, -0.2, 3.1])
    found = []
    for numbers in (raw, torch.cat([raw, torch.zeros(500, 2)], dim=-1)):
        leaf = numbers.clone().requires_grad_()
        log_prob = ProjectedHuber.from_raw(leaf, f=1500.0, S=224.0, mu_z0=2.5e-3, validate_args=False).log_prob(xyz)
        (gradient,) = torch.autograd.grad(log_prob.sum(), leaf)
        found.append((log_prob, gradient[:, :7]))
    assert torch.equal(found[0][0], found[1][0])
    torch.testing.assert_close(found[0][1], found[1][1], rtol=1e-6, atol=1e-6)  # sums in another order


def exact_log_prob(p: ProjectedHuber, xyz: list[float]) -> mp.mpf:
    """-h(|q|) - a max(t, 1/t) - log K, with q as printed plus k a (t - 1)."""
    mu_x, mu_y, mu_z, a, k_1, k_2 = (mp.mpf(v) for v in (*p.mu_xy.tolist(), float(p.mu_z), float(p.a), *p.k.tolist()))
    (A_xx, A_xy), (_, A_yy) = ([mp.mpf(v) for v in row] for row in p.A.tolist())
    x, y, z = map(mp.mpf, xyz)
    t, e_x, e_y = z / mu_z, x / z - mu_x, y / z - mu_y
    q_1 = (A_xx * e_x + A_xy * e_y) * t + k_1 * a * (t - 1)
    q_2 = (A_xy * e_x + A_yy * e_y) * t + k_2 * a * (t - 1)
    r = mp.sqrt(q_1**2 + q_2**2)
    h = r**2 / 2 if r <= 1 else r - mp.mpf(1) / 2
    K_proj = 2 * mp.pi * (1 + mp.exp(-mp.mpf(1) / 2)) * mu_z**2 / (A_xx * A_yy - A_xy**2)
    K_depth = mu_z * (mp.exp(-a) / a + mp.expint(2, a))
    return -h - a * max(t, 1 / t) - mp.log(K_proj) - mp.log(K_depth)


@every_free_axis
def test_log_prob_is_that_of_30_digits(free: ProjectedHuber) -> None:
    xyz = free.rsample((20,), torch.Generator().manual_seed(1))
    with mp.workdps(30):
        exact = [float(exact_log_prob(free, v)) for v in xyz.tolist()]
    torch.testing.assert_close(free.log_prob(xyz), torch.tensor(exact, dtype=torch.float64), rtol=1e-9, atol=1e-9)


@every_free_axis
def test_moments_are_those_of_30_digits(free: ProjectedHuber) -> None:
    """E[v] = (E[z] mu_xy + d (E[z] - mu_z), E[z]) and Var[z] m m^T + c A_xy^(-2), m = (mu_xy + d, 1)."""
    with mp.workdps(60):  # raw moments cancel
        a, mu_z = mp.mpf(float(free.a)), mp.mpf(float(free.mu_z))
        M = [mp.expint(j + 2, a) + mp.expint(-j, a) for j in range(3)]
        mean_z, variance = mu_z * M[1] / M[0], mu_z**2 * (M[2] / M[0] - (M[1] / M[0]) ** 2)
        A_inverse = mp.matrix(free.A.tolist()) ** -1
        mu_xy, d = mp.matrix(free.mu_xy.tolist()), -A_inverse * mp.matrix(free.k.tolist()) * a
        xy = mean_z * mu_xy + d * (mean_z - mu_z)
        c = (2 + 13 * mp.exp(-mp.mpf(1) / 2)) / (2 * (1 + mp.exp(-mp.mpf(1) / 2)))
        m = mp.matrix([*(mu_xy + d), 1])
        covariance = variance * m * m.T
        covariance[:2, :2] = covariance[:2, :2] + c * mu_z**2 * A_inverse * A_inverse
        exact = [[float(value) for value in row] for row in covariance.tolist()]
        mean = [float(v) for v in (*xy, mean_z)]
    torch.testing.assert_close(free.mean, torch.tensor(mean, dtype=torch.float64), rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(
        free.covariance_matrix, torch.tensor(exact, dtype=torch.float64), rtol=1e-7, atol=1e-15
    )


@every_free_axis
def test_it_has_the_mass_of_its_samples(free: ProjectedHuber) -> None:
    """The mean of p'/p over samples of p is 1, here for a narrow p' about the mode."""
    xyz = free.rsample((100_000,), torch.Generator().manual_seed(2))
    narrow = torch.distributions.MultivariateNormal(free.mode, xyz[free.level(xyz) < 0.3].T.cov() / 4)
    ratio = (narrow.log_prob(xyz) - free.log_prob(xyz)).exp()
    assert float(ratio.mean()) == pytest.approx(1, abs=5 * float(ratio.std()) / len(xyz) ** 0.5)
    assert float(ratio.std()) < 10


@every_free_axis
def test_it_is_the_papers_density_moved_to_the_apex(free: ProjectedHuber) -> None:
    paper = ProjectedHuber(free.m_xy, free.mu_z, free.A, free.a)
    xyz = free.rsample((50,), torch.Generator().manual_seed(3))
    torch.testing.assert_close(free.log_prob(xyz), paper.log_prob(xyz - free.apex))
    again = ProjectedHuber.about_axis(free.m_xy, free.apex[:2], free.mu_z, free.A, free.a)
    for name, value in free.parameters.items():
        torch.testing.assert_close(again.parameters[name], value)


def test_a_table_has_k_only_with_a_free_axis_and_rebuilds_it() -> None:
    generator = torch.Generator().manual_seed(4)
    for numbers in (7, 9):
        raw = torch.randn(20, numbers, generator=generator, dtype=torch.float64)
        p = ProjectedHuber.from_raw(raw, f=1500.0, S=224.0, mu_z0=2.5e-3)
        xyz = p.rsample((), generator)
        table = distribution_columns(p, xyz)
        assert ("k_x" in table) == ("k_y" in table) == (numbers == 9)
        assert parameter_columns(p).keys() <= table.keys()
        for name, column in distribution_columns(from_columns(table), xyz).items():
            torch.testing.assert_close(column, table[name], rtol=1e-6, atol=1e-8)

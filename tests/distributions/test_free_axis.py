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

"""Level curves against samples and quadrature."""

import math

import numpy as np
import pytest
import torch
from matplotlib.path import Path as Outline
from scipy import integrate

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.level_curves import LEVELS, level_curves

SAMPLES = 50_000


def _distribution(a: float, precision: float = 200.0, k: tuple[float, float] | None = None) -> ProjectedHuber:
    A = precision * torch.tensor([[1.5, 0.6], [0.6, 0.9]], dtype=torch.float64)
    mu_xy = torch.tensor([0.05, -0.03], dtype=torch.float64)
    mu_z, a_ = torch.tensor([4.0, a], dtype=torch.float64)
    return ProjectedHuber(mu_xy, mu_z, A, a_, k and torch.tensor(k, dtype=torch.float64))


CASES = [
    pytest.param(_distribution(0.5), id="depth hardly known"),
    pytest.param(_distribution(60.0), id="depth known"),
    pytest.param(_distribution(2e3, precision=2.0), id="depth exact, projection vague"),
    pytest.param(_distribution(3.0, k=(0.0, 0.0)), id="free axis along the ray"),
    pytest.param(_distribution(2.0, k=(-1.0, 0.6)), id="free axis, depth hardly known"),
    pytest.param(_distribution(60.0, k=(1.5, 4.0)), id="free axis, depth known"),
]


@pytest.mark.parametrize("distribution", CASES)
def test_a_curve_holds_its_probability(distribution: ProjectedHuber) -> None:
    torch.manual_seed(0)
    xyz = distribution.rsample((SAMPLES,)).numpy()
    curves = level_curves(distribution)
    for places, points in ((curves.projected, xyz[:, :2] / xyz[:, 2:]), (curves.birds_eye, xyz[:, ::2])):
        for level, curve in zip(LEVELS, places, strict=True):
            share = Outline(curve).contains_points(points).mean()
            # polygons lie inside their curves, by less than 0.002 of the probability
            assert abs(share - level) < 4 * math.sqrt(level * (1 - level) / SAMPLES) + 2e-3


@pytest.mark.parametrize("distribution", CASES)
def test_the_law_of_the_projection_is_constant_along_a_curve(distribution: ProjectedHuber) -> None:
    """p(u) = int p(z u, z) z^2 dz: a curve of equal density bounds the smallest region."""
    log_z = np.linspace(-12, 12, 4001) / np.sqrt(float(distribution.a)) + math.log(4)
    z = torch.from_numpy(np.exp(log_z))
    for curve in level_curves(distribution).projected:
        u = torch.from_numpy(curve[::9])
        xyz = torch.cat([u[:, None] * z[:, None], z[:, None].expand(len(u), -1, 1)], dim=-1)
        density = integrate.simpson((distribution.log_prob(xyz).exp() * z**3).numpy(), x=log_z)
        np.testing.assert_allclose(density, density[0], rtol=3e-3)


@pytest.mark.parametrize("distribution", CASES)
def test_the_law_of_the_birds_eye_view_is_constant_along_a_curve(distribution: ProjectedHuber) -> None:
    """p(x, z) = int p(x, y, z) dy."""
    A_inverse = torch.linalg.inv(distribution.A).numpy()
    for curve in level_curves(distribution).birds_eye:
        xz = curve[::11]
        reach = 60 * 4 * A_inverse[1, 1]
        places = torch.from_numpy(xz)
        axis = distribution.apex[1] + distribution.m_xy[1] * places[:, 1]
        y = torch.from_numpy(np.linspace(-reach, reach, 8001)) + axis[:, None]
        x, z = (places[:, None, i].expand_as(y) for i in (0, 1))
        xyz = torch.stack([x, y, z], dim=-1)
        density = integrate.simpson(distribution.log_prob(xyz).exp().numpy(), x=y.numpy())
        np.testing.assert_allclose(density, density[0], rtol=1e-2)


def test_one_distribution_and_levels_between_none_and_all() -> None:
    with pytest.raises(ValueError, match=r"one distribution, not of \(2,\)"):
        level_curves(_distribution(3.0).expand([2]))
    with pytest.raises(ValueError, match="between 0 and 1"):
        level_curves(_distribution(3.0), (0.5, 1.0))

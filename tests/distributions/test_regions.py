"""Credible levels against quadrature; their regions against rays and samples that use the level alone."""

import itertools
import math
from functools import cache

import numpy as np
import pytest
import torch
from matplotlib.path import Path as Outline
from scipy import integrate
from scipy.spatial import ConvexHull

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.huber import radial_cdf
from phd_exp.distributions.level import credible_level
from phd_exp.distributions.regions import PRECISIONS, Region, level_energies
from phd_exp.distributions.rounded import depth_law
from phd_exp.distributions.special import tail_moment

LEVELS = (0.2, 0.9, 0.999)
AXES = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.36, -0.48, 0.8), (-0.6, 0.0, 0.8))


@cache
def border(p: ProjectedHuber, level: float, n: int = 1500) -> np.ndarray:
    """Where rays from the mode, scaled by the covariance, reach the level."""
    random = torch.Generator().manual_seed(0)
    rays = torch.randn(n, 3, generator=random, dtype=torch.float64)
    rays = rays / rays.norm(dim=-1, keepdim=True) @ torch.linalg.cholesky(p.covariance_matrix).mT
    low, high = torch.zeros(n, 1, dtype=torch.float64), torch.full((n, 1), 100.0, dtype=torch.float64)
    for _ in range(30):
        middle = (low + high) / 2
        inside = (p.level(p.mode + middle * rays) <= level)[:, None]
        low, high = torch.where(inside, middle, low), torch.where(inside, high, middle)
    return (p.mode + low * rays).numpy()


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("rounding", [0.0, 2.0])
def test_energies_are_those_of_the_level(level: float, rounding: float) -> None:
    log_a = torch.linspace(math.log(1e-4), math.log(1e5), 1000, dtype=torch.float64)
    W = np.interp(log_a, PRECISIONS.log(), level_energies(level, rounding))
    np.testing.assert_allclose(depth_law(log_a, rounding).level(torch.from_numpy(W)), level, atol=1e-4)


@pytest.mark.parametrize("level", LEVELS)
def test_the_extent_along_any_axis_is_reached_and_never_exceeded(distribution: ProjectedHuber, level: float) -> None:
    region, points = Region(distribution, level), border(distribution, level)
    for axis in map(np.array, AXES):
        low, high = region.depth_interval(axis)
        along, width = points @ axis, high - low
        assert low - 1e-3 * width < along.min() < low + 0.06 * width
        assert high - 0.06 * width < along.max() < high + 1e-3 * width


def test_regions_of_a_batch_are_those_of_its_members(distribution: ProjectedHuber) -> None:
    """Each with its own level and direction."""
    batch, axes = distribution.expand([len(LEVELS)]), np.array(AXES[-len(LEVELS) :])
    regions = Region(batch, np.array(LEVELS))
    for row, (level, axis) in enumerate(zip(LEVELS, axes, strict=True)):
        alone = Region(distribution, level)
        np.testing.assert_allclose([end[row] for end in regions.depth_interval(axes)], alone.depth_interval(axis))
        np.testing.assert_allclose(regions.volume[row], alone.volume)


def test_depth_reaches_from_mu_z_over_t_to_mu_z_times_t(distribution: ProjectedHuber) -> None:
    low, high = Region(distribution, 0.9).depth_interval()
    assert low * high == pytest.approx(float(distribution.mu_z) ** 2)
    W = float(distribution.depth_energy(torch.tensor(high, dtype=torch.float64)))
    assert float(distribution.depth_law.level(torch.tensor(W).double())) == pytest.approx(0.9, abs=2e-5)


@pytest.mark.parametrize("level", LEVELS)
def test_the_volume_is_that_of_the_positions_up_to_the_level(distribution: ProjectedHuber, level: float) -> None:
    """Uniform samples of each disc's bounding box at uniform depths, which a box in space would mostly miss."""
    region, n = Region(distribution, level), 40_000
    random = np.random.default_rng(1)
    low, high = region.depth_interval()
    z = random.uniform(low, high, n)
    widest = np.sqrt(
        max(np.square(distribution.whiten(torch.from_numpy(border(distribution, level))).numpy()).sum(-1))
    )
    q = random.uniform(-1.05 * widest, 1.05 * widest, (n, 2))
    A_xy = distribution.A.numpy() / float(distribution.mu_z)
    xy = distribution.apex[:2].numpy() + z[:, None] * distribution.m_xy.numpy() + np.linalg.solve(A_xy, q.T).T
    inside = (distribution.level(torch.from_numpy(np.column_stack([xy, z]))) <= level).numpy()
    share, box = inside.mean(), (high - low) * (2.1 * widest) ** 2 / np.linalg.det(A_xy)
    assert region.volume == pytest.approx(share * box, rel=5 * math.sqrt((1 - share) / (share * n)))


@pytest.mark.parametrize("level", LEVELS)
def test_outlines_are_those_of_the_region(distribution: ProjectedHuber, level: float) -> None:
    points = border(distribution, level)
    views = points[:, :2] / points[:, 2:], points[:, ::2]
    for outline, view in zip(Region(distribution, level).outlines(), views, strict=True):
        np.testing.assert_array_equal(outline[0], outline[-1])
        scale = np.ptp(outline, axis=0)
        middle = outline.mean(0)
        whole = Outline((outline - middle) / scale * 1.005)
        assert whole.contains_points((view - middle) / scale).all()
        area = ConvexHull((view - middle) / scale).volume
        assert area == pytest.approx(ConvexHull((outline - middle) / scale).volume, rel=0.05)


ENERGIES = [0.0, 1e-3, 0.2, 0.5, 0.51, 1.7, 6.0, 30.0]
DEPTH_PRECISIONS = [1e-4, 0.05, 0.7, 1.0, 4.0, 100.0, 1e6]


def tensor(value: float) -> torch.Tensor:
    return torch.tensor(value, dtype=torch.float64)


def level_by_quadrature(W: float, a: float) -> float:
    """P(h(|q|) + w <= W), integrating over the excess depth energy w in log(1 + w/a), where both sides are smooth."""
    norm = 1 + tail_moment(0, tensor(a)).item()

    def integrand(u: float) -> float:
        w = a * math.expm1(u)
        density = math.exp(-w) * (1 + math.exp(-2 * u)) / norm
        energy = max(W - w, 0.0)  # h(r) <= energy up to this r
        r = math.sqrt(2 * energy) if energy <= 0.5 else energy + 0.5
        return density * radial_cdf(tensor(r)).item() * a * math.exp(u)

    borders = [0.0, math.log1p(max(W - 0.5, 0) / a), math.log1p(W / a)]
    return sum(
        integrate.quad(integrand, low, high, epsabs=1e-12, limit=200)[0] for low, high in itertools.pairwise(borders)
    )


@pytest.mark.parametrize("a", DEPTH_PRECISIONS)
@pytest.mark.parametrize("W", ENERGIES)
def test_level_is_the_integral(W: float, a: float) -> None:
    assert credible_level(tensor(W), tensor(a)).item() == pytest.approx(level_by_quadrature(W, a), abs=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("a", [0.0, *DEPTH_PRECISIONS])
def test_level_grows_from_zero_to_one_in_float32_as_in_float64(a: float, dtype: torch.dtype) -> None:
    W = torch.cat([torch.zeros(1, dtype=dtype), torch.logspace(-2, 6, 400, dtype=dtype)])
    level = credible_level(W, torch.tensor(a, dtype=dtype))
    exact = credible_level(W.double(), torch.tensor(a, dtype=dtype).double())
    torch.testing.assert_close(level.double(), exact, rtol=0, atol=2e-6)
    assert (level.diff() >= -4 * torch.finfo(dtype).eps).all()
    assert level[0] <= 4 * torch.finfo(dtype).eps
    assert level[-1] == 1
    assert credible_level(torch.tensor(torch.inf, dtype=dtype), torch.tensor(a, dtype=dtype)) == 1

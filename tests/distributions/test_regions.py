"""Regions of a level, and their surfaces and outlines, against rays and samples that use the level alone."""

import math
from functools import cache

import numpy as np
import pytest
import torch
from matplotlib.path import Path as Outline
from scipy.spatial import ConvexHull

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.regions import PRECISIONS, Region, level_energies
from phd_exp.distributions.rounded import depth_law

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
    W = distribution.depth_law.energy(torch.tensor(high, dtype=torch.float64).log() - distribution.mu_z.log())
    assert float(distribution.depth_law.level(W)) == pytest.approx(0.9, abs=2e-5)


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

"""Surfaces of regions: on the level, closed, turned outwards, and around the volume of the region."""

from collections import Counter

import numpy as np
import pytest
import torch

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.regions import Region
from phd_exp.distributions.surfaces import Surface, ellipsoid, level_surface


def volume(surface: Surface) -> float:
    """By the divergence theorem; negative if the triangles are turned inwards."""
    a, b, c = (surface.vertices - surface.vertices.mean(0))[surface.triangles.T]
    return float((a * np.cross(b, c)).sum() / 6)


def require_closed(surface: Surface) -> None:
    """Each edge has one triangle on each side, in opposite directions (and V - E + F = 2)."""
    edges = Counter((a, b) for one in surface.triangles.tolist() for a, b in zip(one, one[1:] + one[:1], strict=True))
    assert set(edges.values()) == {1}
    assert all((b, a) in edges for a, b in edges)
    assert len(surface.vertices) - len(edges) // 2 + len(surface.triangles) == 2


@pytest.mark.parametrize("level", [0.5, 0.9])
def test_a_level_surface_is_closed_and_has_its_level_and_volume(distribution: ProjectedHuber, level: float) -> None:
    surface = level_surface(distribution, level)
    require_closed(surface)
    np.testing.assert_allclose(distribution.level(torch.from_numpy(surface.vertices)), level, atol=2e-3)
    assert 0.95 < volume(surface) / Region(distribution, level).volume < 1  # inscribed in a convex body
    outwards = ((surface.vertices - distribution.mode.numpy()) * surface.normals).sum(-1)
    assert (outwards > 0).all()


@pytest.mark.parametrize("level", [0.5, 0.9])
def test_an_ellipsoid_holds_its_share_of_a_gaussian(level: float) -> None:
    random = np.random.default_rng(0)
    mean, factor = np.array([0.3, -0.2, 4.0]), np.array([[0.1, 0, 0], [0.02, 0.05, 0], [0.1, -0.1, 0.8]])
    surface = ellipsoid(mean, factor @ factor.T, level)
    require_closed(surface)
    radii = np.linalg.norm(np.linalg.solve(factor, (surface.vertices - mean).T), axis=0)
    assert np.ptp(radii) < 1e-9
    inside = np.linalg.norm(random.standard_normal((100_000, 3)), axis=-1) < radii[0]
    assert abs(inside.mean() - level) < 4 * np.sqrt(level * (1 - level) / 100_000)
    assert volume(surface) == pytest.approx(4 / 3 * np.pi * radii[0] ** 3 * np.linalg.det(factor), rel=0.02)

"""Surfaces of regions: on the level, closed, turned outwards, and around the volume of the region."""

from collections import Counter

import numpy as np
import pytest
import torch
from matplotlib.path import Path as Outline

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.regions import Region
from phd_exp.distributions.surfaces import Surface, ellipsoid, level_surface, outline
from phd_exp.geometry import Lens, intrinsics
from phd_exp.optics.virtual import VirtualCamera, towards
from tests.support.opencv import projected


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


@pytest.mark.parametrize(
    "lens", [Lens(), Lens((-0.2, 0.05, 0.001, -0.002)), Lens((0.01, -0.002, 0.0, 0.0), is_fisheye=True)]
)
def test_an_outline_is_around_all_points_as_opencv_projects_them(lens: Lens) -> None:
    K, mean = intrinsics(310.0, 290.0, 150.0, 110.0), np.array([0.6, -0.3, 3.0])
    surface = ellipsoid(mean, np.diag([0.04, 0.01, 0.25]) ** 2 + 0.0009, 0.9)
    camera = VirtualCamera(K, towards(mean), 1.0, 1.0, lens)
    curve, pixels = outline(camera.to_virtual(surface.vertices), camera), projected(surface.vertices, K, lens)
    assert np.array_equal(curve[0], curve[-1])
    nearest = np.linalg.norm(curve[:, None] - pixels, axis=-1).min(-1)
    assert nearest.max() < 1e-6
    assert Outline(curve).contains_points(pixels, radius=0.02).all()


def test_a_body_around_the_camera_has_no_outline() -> None:
    points = ellipsoid(np.array([0.0, 0.0, 0.5]), np.eye(3), 0.9).vertices
    assert len(outline(points, VirtualCamera(intrinsics(310.0, 290.0, 150.0, 110.0), np.eye(3), 1.0, 1.0))) == 0

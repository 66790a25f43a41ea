"""Ray casting against a search along every ray, and counts of pixels; the meshes of the same solids; rotations."""

import math
from collections import Counter
from typing import get_args

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from phd_exp.records.scenes import Scene, SceneObject, Shape
from phd_exp.rendering.meshes import Mesh, build_mesh
from phd_exp.rendering.rays import rotation_matrix, trace_pixels, trace_points, truncation, visibility
from phd_exp.rendering.sampling import about_axis, uniform_rotation
from tests.support.renders import placed, silhouettes, with_objects

STEP = 2e-3  # m


def marched(scene: Scene) -> np.ndarray:
    """Depth maps by walking along every ray and asking whether the point lies in the solid."""
    middles = (np.arange(scene.S) + 0.5 - scene.S / 2) / scene.f
    u, w = np.meshgrid(middles, middles)
    depths = np.arange(2.6, 5.4, STEP)
    points = depths[:, None, None, None] * np.stack([u, w, np.ones_like(u)], axis=-1)
    return np.stack([first_inside(item, points, depths) for item in scene.objects])


def first_inside(item: SceneObject, points: np.ndarray, depths: np.ndarray) -> np.ndarray:
    local = (points - np.array(item.position)) @ rotation_matrix(item.rotation) / item.scale
    x, y, z = np.moveaxis(local, -1, 0)
    inside = {
        "cylinder": (np.hypot(x, y) <= 0.1) & (np.abs(z) <= 0.1),
        "cube": np.abs(local).max(axis=-1) <= 0.1,
        "sphere": np.linalg.norm(local, axis=-1) <= 0.1,
    }[item.shape]
    return np.where(inside.any(axis=0), depths[inside.argmax(axis=0)], np.inf)


def test_rays_find_what_a_search_finds(scenes: list[Scene]) -> None:
    for scene in scenes[:1]:
        cast, walked = trace_pixels(scene).depths, marched(scene)
        # A ray that grazes a solid for less than a step is missed by the search.
        assert (np.isfinite(cast) & ~np.isfinite(walked)).sum() <= 3
        assert not (np.isfinite(walked) & ~np.isfinite(cast)).any()
        both = np.isfinite(cast) & np.isfinite(walked)
        assert both.sum() > 50
        delay = walked[both] - cast[both]
        assert delay.min() >= -1e-9
        assert delay.max() <= STEP + 1e-9


def test_points_at_the_middles_of_pixels_meet_what_pixels_meet(scenes: list[Scene]) -> None:
    """Windows around objects save work and change nothing."""
    for scene in scenes[:4]:
        middles = np.arange(scene.S) + 0.5
        x, y = np.meshgrid(middles, middles)
        points, pixels = trace_points(scene, x, y), trace_pixels(scene)
        assert points.depths == pytest.approx(pixels.depths, rel=1e-12)
        assert (points.surfaces == pixels.surfaces).all()


def test_what_lies_behind_the_camera_is_not_seen(scenes: list[Scene]) -> None:
    scene = with_objects(scenes[0], placed(scenes[0], position=(0.0, 0.0, -3.0)))
    assert not silhouettes(trace_pixels(scene)).any()


def test_visibility_counts_pixels(scenes: list[Scene]) -> None:
    for scene in scenes:
        hits = trace_pixels(scene)
        own, others = hits.depths[0], hits.depths[1:].min(axis=0)
        assert visibility(hits) == pytest.approx((own < others).sum() / np.isfinite(own).sum())
    assert min(visibility(trace_pixels(scene)) for scene in scenes) < 1, "some cylinder has to be occluded"


@pytest.mark.parametrize(
    ("x", "expected"), [(0.0, 0.0), (0.4, 0.5), (2.0, 1.0)], ids=["inside", "half outside", "outside"]
)
def test_truncation_is_the_share_beyond_the_border(scenes: list[Scene], x: float, expected: float) -> None:
    """Half of a ball at the middle of the right border lies outside, apart from perspective."""
    scene = scenes[0].model_copy(update={"f": 200.0})  # the border is at x = 0.1 z
    ball = placed(scene, shape="sphere", position=(x, 0.0, 4.0))
    alone = with_objects(scene, ball)
    hits = trace_pixels(alone)
    assert truncation(alone, hits) == pytest.approx(expected, abs=0.05)
    assert visibility(hits) == (expected < 1)


def test_an_occluder_truncates_nothing(scenes: list[Scene]) -> None:
    for scene in scenes:
        alone = with_objects(scene, scene.objects[0])
        assert truncation(scene, trace_pixels(scene)) == truncation(alone, trace_pixels(alone))


def test_a_matrix_is_that_of_its_quaternion() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        quaternion = uniform_rotation(rng)
        w, x, y, z = quaternion
        assert math.hypot(*quaternion) == pytest.approx(1, abs=1e-12)
        expected = Rotation.from_quat([x, y, z, w]).as_matrix()
        assert rotation_matrix(quaternion) == pytest.approx(expected, abs=1e-12)
        assert rotation_matrix((-w, -x, -y, -z)) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("angle", [-3.0, 0.0, 0.3, math.pi / 2])
def test_a_turn_about_an_axis_is_right_handed(angle: float) -> None:
    for axis in ((1.0, 0.0, 0.0), (0.0, 0.6, -0.8)):
        expected = Rotation.from_rotvec(angle * np.array(axis)).as_matrix()
        assert rotation_matrix(about_axis(axis, angle)) == pytest.approx(expected, abs=1e-12)


VOLUME = {"cylinder": 2 * math.pi, "cube": 8.0, "sphere": 4 / 3 * math.pi}
SHAPES = get_args(Shape)


def directed_edges(mesh: Mesh) -> Counter[tuple[tuple[float, ...], tuple[float, ...]]]:
    """Edges by the places of their ends: vertices that share a place are one."""
    places = [tuple(np.round(point, 9).tolist()) for point in mesh.vertices]
    return Counter(
        (places[a], places[b]) for face in mesh.faces for a, b in zip(face, (*face[1:], face[0]), strict=True)
    )


@pytest.mark.parametrize("shape", SHAPES)
def test_a_mesh_is_closed_faces_outward_and_is_its_solid(shape: Shape) -> None:
    mesh = build_mesh(shape)
    edges = directed_edges(mesh)
    assert set(edges.values()) == {1}, "every edge is walked once in each direction"
    assert all((b, a) in edges for a, b in edges)

    points = np.array(mesh.vertices)
    triangles = [(face[0], face[k], face[k + 1]) for face in mesh.faces for k in range(1, len(face) - 1)]
    volume = np.linalg.det(points[np.array(triangles)]).sum() / 6
    assert volume == pytest.approx(VOLUME[shape], rel=1e-3), "positive, since faces look outward"

    x, y, z = points.T
    distance = {
        "cylinder": np.maximum(np.hypot(x, y), np.abs(z)),
        "cube": np.abs(points).max(axis=1),
        "sphere": np.linalg.norm(points, axis=1),
    }[shape]
    assert distance == pytest.approx(1.0), "every vertex lies on the surface"

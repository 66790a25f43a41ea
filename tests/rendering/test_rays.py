"""Ray casting against a search along every ray, and against what must be so."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from phd_exp.records.scenes import Scene, SceneObject
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.rays import NOTHING, cylinder_mask, trace_pixels, trace_points
from phd_exp.rendering.rotations import rotation_matrix
from phd_exp.rendering.sampling import sample_scene
from tests.rendering.folders import silhouettes

MakeSpec = Callable[..., DatasetSpec]
STEP = 2e-3  # m


@pytest.fixture(scope="module")
def scenes(make_spec: MakeSpec) -> list[Scene]:
    spec = make_spec("occl_scale", sensor_size=40, f_range=(200.0, 300.0))
    return [sample_scene(spec, "train", index) for index in range(12)]


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
    for scene in scenes[:3]:
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
    for scene in scenes:
        middles = np.arange(scene.S) + 0.5
        x, y = np.meshgrid(middles, middles)
        points, pixels = trace_points(scene, x, y), trace_pixels(scene)
        assert points.depths == pytest.approx(pixels.depths, rel=1e-12)
        assert (points.surfaces == pixels.surfaces).all()


def test_what_is_seen_is_the_nearest(scenes: list[Scene]) -> None:
    for scene in scenes:
        hits = trace_pixels(scene)
        nothing = np.isinf(hits.depths).all(axis=0)
        assert ((hits.first == NOTHING) == nothing).all()
        depth_of_first = np.where(hits.surfaces == hits.first, hits.depths, np.inf).min(axis=0)
        assert (depth_of_first[~nothing] == hits.depths.min(axis=0)[~nothing]).all()


def placed(scene: Scene, **changes: Any) -> SceneObject:
    straight = {"rotation": (1.0, 0.0, 0.0, 0.0), "scale": 1.0}
    return scene.objects[0].model_copy(update=straight | changes)


def test_what_lies_behind_the_camera_is_not_seen(scenes: list[Scene]) -> None:
    scene = scenes[0].model_copy(update={"objects": (placed(scenes[0], position=(0.0, 0.0, -3.0)),)})
    assert not silhouettes(trace_pixels(scene)).any()


def test_axes_and_pixel_middles(scenes: list[Scene]) -> None:
    """x points right, y down, z away; the principal point lies between the four middle pixels."""
    side, f = scenes[0].S, scenes[0].f
    for direction, (row, column) in {(1, 0): (0, 10), (0, 1): (10, 0)}.items():
        centre = tuple(10 * 4.0 / f * axis for axis in direction)
        ball = placed(scenes[0], shape="sphere", position=(*centre, 4.0))
        mask = cylinder_mask(trace_pixels(scenes[0].model_copy(update={"objects": (ball,)})))
        middle = np.argwhere(mask).mean(axis=0) + 0.5
        assert middle == pytest.approx([side / 2 + row, side / 2 + column], abs=0.2)


def test_the_axis_of_a_cylinder_is_its_local_z(scenes: list[Scene]) -> None:
    """BackboneOutput along its axis a cylinder is a disc, seen from the side a square."""
    area = (2 * 0.1 * scenes[0].f / 4.0) ** 2
    along = placed(scenes[0], position=(0.0, 0.0, 4.1))
    aside = placed(scenes[0], position=(0.0, 0.0, 4.1), rotation=(0.5**0.5, 0.5**0.5, 0.0, 0.0))
    for item, share in ((along, np.pi / 4), (aside, 1.0)):
        pixels = silhouettes(trace_pixels(scenes[0].model_copy(update={"objects": (item,)}))).sum()
        assert pixels == pytest.approx(area * share, rel=0.12)


def test_a_silhouette_lies_about_the_projected_position(make_spec: MakeSpec) -> None:
    """Nearly: the near half of a solid looks larger than the far one, by (size / depth)^2 of its own extent."""
    for index in range(10):
        scene = sample_scene(make_spec(xy_range=0.2), "train", index)
        x, y, z = scene.objects[0].position
        projection = np.array([y, x]) / z * scene.f + scene.S / 2
        middle = np.argwhere(silhouettes(trace_pixels(scene))).mean(axis=0) + 0.5
        assert np.abs(middle - projection).max() < 1.5

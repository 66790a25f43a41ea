"""Counts of pixels: what hides a cylinder, and what lies beyond the image's border."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from phd_exp.records.scenes import Scene, SceneObject
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.rays import trace_pixels, truncation, visibility
from phd_exp.rendering.sampling import sample_scene
from tests.rendering.folders import silhouettes

MakeSpec = Callable[..., DatasetSpec]


@pytest.fixture(scope="module")
def scenes(make_spec: MakeSpec) -> list[Scene]:
    spec = make_spec("occl_scale", sensor_size=40, f_range=(200.0, 300.0))
    return [sample_scene(spec, "train", index) for index in range(12)]


def test_visibility_counts_pixels(scenes: list[Scene]) -> None:
    for scene in scenes:
        hits = trace_pixels(scene)
        depths = hits.depths
        alone = sum(np.isfinite(depths[0]).ravel().tolist())
        seen = sum(
            own < min(other)
            for own, *other in zip(*(depth.ravel().tolist() for depth in depths), strict=True)
        )
        assert visibility(hits) == pytest.approx(seen / alone)
        assert 0 <= visibility(hits) <= 1
    assert min(visibility(trace_pixels(scene)) for scene in scenes) < 1, "some cylinder has to be occluded"


def placed(scene: Scene, **changes: Any) -> SceneObject:
    straight = {"rotation": (1.0, 0.0, 0.0, 0.0), "scale": 1.0}
    return scene.objects[0].model_copy(update=straight | changes)


@pytest.mark.parametrize(
    ("position", "expected"),
    [((0.0, 0.0, 3.0), 0.0), ((0.0, 0.0, 5.0), 1.0), ((0.6, 0.0, 3.0), 1.0)],
    ids=["before", "behind", "beside"],
)
def test_a_large_occluder_hides_all_or_nothing(
    scenes: list[Scene], position: tuple[float, float, float], expected: float
) -> None:
    cylinder = placed(scenes[0], position=(0.0, 0.0, 4.0))
    cube = placed(scenes[0], shape="cube", position=position, scale=2.0)
    scene = scenes[0].model_copy(update={"objects": (cylinder, cube)})
    assert visibility(trace_pixels(scene)) == expected


def test_a_cylinder_outside_the_image_is_not_visible(scenes: list[Scene]) -> None:
    scene = scenes[0].model_copy(update={"objects": (placed(scenes[0], position=(2.0, 0.0, 3.0)),)})
    assert not silhouettes(trace_pixels(scene)).any()
    assert visibility(trace_pixels(scene)) == 0.0


@pytest.mark.parametrize(
    ("x", "expected"), [(0.0, 0.0), (0.4, 0.5), (2.0, 1.0)], ids=["inside", "half outside", "outside"]
)
def test_truncation_is_the_share_beyond_the_border(scenes: list[Scene], x: float, expected: float) -> None:
    """A ball about the middle of the right border lies half outside, but for what perspective adds."""
    scene = scenes[0].model_copy(update={"f": 200.0})  # the border is at x = 0.1 z
    ball = placed(scene, shape="sphere", position=(x, 0.0, 4.0))
    alone = scene.model_copy(update={"objects": (ball,)})
    assert truncation(alone, trace_pixels(alone)) == pytest.approx(expected, abs=0.05)


def test_an_occluder_truncates_nothing(scenes: list[Scene]) -> None:
    for scene in scenes:
        alone = scene.model_copy(update={"objects": scene.objects[:1]})
        assert truncation(scene, trace_pixels(scene)) == truncation(alone, trace_pixels(alone))

"""Ray casting: windows, counts of pixels, and rotations. `test_truth.py` holds it against Blender."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from phd_exp.records.scenes import Scene
from phd_exp.rendering.rays import rotation_matrix, trace_pixels, trace_points, truncation, visibility
from phd_exp.rendering.sampling import about_axis, uniform_rotation
from tests.support.renders import placed, silhouettes, with_objects


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

"""Scenes follow the paper's laws, depend on (seed, split, index) alone, and are paired across variants."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats

from phd_exp.records.scenes import Scene
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.rays import rotation_matrix
from phd_exp.rendering.sampling import sample_scene
from tests.support.renders import VARIANTS

MakeSpec = Callable[..., DatasetSpec]
MANY = 1000
UNLIKELY = 1e-3  # the seeds are fixed: a law either holds at this level for ever or never


@pytest.fixture(scope="module")
def scenes(make_spec: MakeSpec) -> list[Scene]:
    return [sample_scene(make_spec("occl_scale"), "train", index) for index in range(MANY)]


def assert_uniform(values: list[float], low: float, high: float) -> None:
    assert min(values) >= low
    assert max(values) <= high
    assert stats.kstest(values, stats.uniform(low, high - low).cdf).pvalue > UNLIKELY


@pytest.mark.parametrize("which", range(3))
def test_every_object_has_the_papers_position_and_scale(scenes: list[Scene], which: int) -> None:
    assert_uniform([scene.f for scene in scenes], 1200, 2000)
    items = [(scene, scene.objects[which]) for scene in scenes]
    assert_uniform([item.position[2] for _, item in items], 3, 5)
    assert_uniform([item.scale for _, item in items], 0.8, 1.2)
    for axis in range(2):
        shares = [item.position[axis] * scene.f / (scene.S * item.position[2]) for scene, item in items]
        assert_uniform(shares, -0.5, 0.5)


@pytest.mark.parametrize("which", range(3))
def test_orientations_are_uniform_over_the_rotations(scenes: list[Scene], which: int) -> None:
    """Each entry of a Haar rotation is uniform on [-1, 1]; its angle has the density (1 - cos) / pi."""
    matrices = np.array([rotation_matrix(scene.objects[which].rotation) for scene in scenes])
    for row in range(3):
        for column in range(3):
            assert_uniform(matrices[:, row, column].tolist(), -1, 1)
    angles = np.arccos((np.trace(matrices, axis1=1, axis2=2) - 1) / 2)
    assert stats.kstest(angles, lambda angle: (angle - np.sin(angle)) / np.pi).pvalue > UNLIKELY


def test_objects_are_independent(scenes: list[Scene]) -> None:
    drawn = np.array(
        [
            [value for item in scene.objects for value in (item.position[2], item.scale, item.colour[0])]
            for scene in scenes
        ]
    )
    correlation = np.corrcoef(drawn.T)
    same = np.kron(np.eye(3), np.ones((3, 3))).astype(bool)
    assert np.abs(correlation[~same]).max() < 4 / MANY**0.5


def test_both_materials_and_all_hues_occur(scenes: list[Scene]) -> None:
    metal = sum(scene.objects[0].material == "metal" for scene in scenes)
    assert stats.binomtest(metal, MANY).pvalue > UNLIKELY
    strongest = [int(np.argmax(scene.objects[0].colour)) for scene in scenes]
    assert stats.chisquare(np.bincount(strongest)).pvalue > UNLIKELY


def test_what_the_paper_fixes_is_fixed(scenes: list[Scene]) -> None:
    for scene in scenes:
        assert [item.shape for item in scene.objects] == ["cylinder", "cube", "sphere"]
        assert all(item.dimensions == (0.2, 0.2, 0.2) for item in scene.objects)
        assert [lamp.name for lamp in scene.lamps] == ["key", "fill", "back"]
        assert scene.S == 224


def test_variants_are_paired(make_spec: MakeSpec) -> None:
    """Occluders are added and scales changed; nothing else differs, occluders included."""
    for index in range(50):
        default, occl, scale, both = (sample_scene(make_spec(variant), "train", index) for variant in VARIANTS)
        assert occl.model_copy(update={"objects": occl.objects[:1]}) == default
        assert unscaled(scale) == default
        assert unscaled(both) == occl
        assert both.objects[0] == scale.objects[0]
        assert all(item.scale == 1 for item in occl.objects)


def unscaled(scene: Scene) -> Scene:
    objects = tuple(item.model_copy(update={"scale": 1.0}) for item in scene.objects)
    return scene.model_copy(update={"objects": objects})


@pytest.mark.parametrize(("variant", "index"), [("occl_scale", 5), ("multiview", 6)])
def test_a_scene_depends_only_on_seed_split_and_index(make_spec: MakeSpec, variant: str, index: int) -> None:
    spec = make_spec(variant)
    scene = sample_scene(spec, "train", index)
    sample_scene(spec, "train", index - 1)
    np.random.seed(3)
    assert sample_scene(spec, "train", index) == scene
    others = ((spec, "test", index), (spec, "train", index + 1), (make_spec(variant, seed=1), "train", index))
    for other in others:
        assert sample_scene(*other).f != scene.f


def test_a_scene_is_the_same_for_ever(make_spec: MakeSpec) -> None:
    """Numbers of generator version 1: if they change, so must GENERATOR_VERSION."""
    scene = sample_scene(make_spec("occl_scale"), "test", 7)
    assert scene.f == pytest.approx(1327.6351861766607, rel=1e-14)
    assert scene.objects[0].position == pytest.approx((0.26127093599, -0.0568530401749, 3.8616721129), rel=1e-9)
    assert scene.objects[2].scale == pytest.approx(1.178370938, rel=1e-9)
    assert scene.noise_seed == 2146766929


def test_the_authors_generator_uses_half_of_the_image(make_spec: MakeSpec) -> None:
    whole, half = (sample_scene(make_spec(xy_range=share), "train", 3).objects[0] for share in (1.0, 0.5))
    assert half.position == pytest.approx((whole.position[0] / 2, whole.position[1] / 2, whole.position[2]))


def test_lamps_stand_still_without_jitter(make_spec: MakeSpec) -> None:
    still = [sample_scene(make_spec(lamp_jitter=0.0), "train", index).lamps for index in range(3)]
    assert still[0] == still[1] == still[2]
    moved = [sample_scene(make_spec(), "train", index).lamps for index in range(3)]
    assert moved[0] != moved[1]


def test_light_tells_depth_less_than_its_jitter_hides(make_spec: MakeSpec) -> None:
    """Irradiance of the key lamp over the range of depths, against its spread over samples."""
    keys = [sample_scene(make_spec(), "train", index).lamps[0] for index in range(200)]

    def light(depth: float) -> np.ndarray:
        return np.array([key.power / np.sum((np.array(key.position) - (0, 0, depth)) ** 2) for key in keys])

    near, far = np.log(light(3.0)), np.log(light(5.0))
    assert abs(np.mean(near - far)) < np.std(near)

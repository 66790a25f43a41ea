"""Scenes follow the paper's laws, depend on (seed, split, index) alone, and are paired across variants."""

from colorsys import rgb_to_hsv

import numpy as np
import pytest
from scipy import stats

from phd_exp.records.scenes import Scene
from phd_exp.rendering.rays import NOTHING, rotation_matrix, trace_pixels, truncation, visibility
from phd_exp.rendering.sampling import sample_scene
from tests.support.renders import UNLIKELY, VARIANTS, MakeSpec, with_objects

MANY = 1000


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


@pytest.mark.parametrize(("variant", "index"), [("occl_scale", 5), ("multiview", 7), ("sequence", 39)])
def test_a_scene_depends_only_on_seed_split_and_index(make_spec: MakeSpec, variant: str, index: int) -> None:
    spec = make_spec(variant)
    scene = sample_scene(spec, "train", index)
    sample_scene(spec, "train", index - 1)
    np.random.seed(3)
    assert sample_scene(spec, "train", index) == scene
    others = ((spec, "test", index), (spec, "train", index + 1), (make_spec(variant, seed=1), "train", index))
    for other in others:
        assert sample_scene(*other).f != scene.f


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


@pytest.mark.parametrize("variant", ["default", "occl_scale"])
def test_a_panel_hides_half_of_the_cylinder_and_changes_nothing_else(make_spec: MakeSpec, variant: str) -> None:
    visible, widths = [], []
    bare, hidden = (make_spec(variant, xy_range=0.5, half_hidden=half) for half in (False, True))
    for index in range(100):
        plain, scene = (sample_scene(spec, "test", index) for spec in (bare, hidden))
        *others, panel = scene.objects
        assert others == [item for item in plain.objects if item.shape != "cube"], "paired"
        assert scene.model_copy(update={"objects": plain.objects}) == plain
        assert 0.6 * plain.objects[0].position[2] <= panel.position[2] <= 0.8 * plain.objects[0].position[2]
        alone = with_objects(scene, scene.objects[0], panel)
        hits = trace_pixels(alone)
        if truncation(alone, hits) == 0:
            visible.append(visibility(hits))
            widths.append((hits.surfaces[1] != NOTHING).mean())
    assert len(visible) > 50
    assert np.mean(visible) == pytest.approx(0.5, abs=0.01)
    np.testing.assert_allclose(visible, 0.5, atol=0.12)  # a cylinder seen along its axis has a frustum's silhouette
    assert min(widths) > 0.02


def test_grey_scenes_have_the_same_hues_and_values(make_spec: MakeSpec) -> None:
    for index in range(20):
        plain = sample_scene(make_spec("occl"), "test", index)
        grey = sample_scene(make_spec("occl", saturation_range=(0.0, 0.1)), "test", index)
        for before, after in zip(plain.objects, grey.objects, strict=True):
            (h, s, v), (h_after, s_after, v_after) = (rgb_to_hsv(*item.colour) for item in (before, after))
            assert 0 <= s_after <= 0.1 < 0.45 <= s <= 0.95
            assert (s_after / 0.1, v_after) == pytest.approx(((s - 0.45) / 0.5, v), abs=1e-9)
            assert h_after == pytest.approx(h, abs=1e-6) or abs(h_after - h) > 1 - 1e-6
            assert after.model_copy(update={"colour": before.colour}) == before

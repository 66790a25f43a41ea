"""Further objects like the first one: parts in a bin."""

import numpy as np
import pytest

from phd_exp.rendering.blender import Renderer, Settings
from phd_exp.rendering.objects import BESIDE, sample_object_scene
from phd_exp.rendering.rays import NOTHING, trace_pixels
from tests.support.meshes import placed, solid
from tests.support.renders import MakeSpec, drawn

CUBE = solid("cube", 0.1)
MESHES = {"mesh": CUBE}


@pytest.mark.parametrize("looks", ["plain", "varied"])
def test_copies_lie_around_an_unchanged_scene_and_look_like_its_object(of_mesh: MakeSpec, looks: str) -> None:
    spec = of_mesh(distractors=1, looks=looks, scale_range=(0.5, 1.0))
    directions, rotations = [], set()
    for alone, scene in zip(
        drawn(spec, 100, MESHES), drawn(spec.model_copy(update={"copies": 3}), 100, MESHES), strict=True
    ):
        n = len(alone.objects)
        assert scene.model_copy(update={"objects": scene.objects[:n]}) == alone
        first, copies = scene.objects[0], scene.objects[n:]
        assert len(copies) == 3
        for copy in copies:
            assert copy.model_copy(update={"position": first.position, "rotation": first.rotation}) == first
            shift = np.subtract(copy.position, first.position)
            direction = shift / np.linalg.norm(shift)
            gap = (placed(CUBE, copy) @ direction).min() - (placed(CUBE, first) @ direction).max()
            touching = np.linalg.norm(shift) - gap
            assert BESIDE[0] <= np.linalg.norm(shift) / touching <= BESIDE[1]
            directions.append(direction)
            rotations.add(copy.rotation)
    assert len(rotations) == 300
    assert np.abs(np.mean(directions, axis=0)).max() < 0.15, "3.5 standard errors of the mean of 600 directions"


@pytest.mark.parametrize("law", ["upright", "resting"])
def test_copies_of_an_object_on_a_table_lie_on_the_table(of_mesh: MakeSpec, law: str) -> None:
    spec = of_mesh(**{law: True}, ground=True, pitch_range=(20.0, 40.0), scale_range=(0.5, 1.0), copies=2)
    for scene in drawn(spec, 50, MESHES):
        assert scene.surroundings is not None
        assert scene.surroundings.ground is not None
        up = np.array([0.0, -np.cos(scene.surroundings.pitch), -np.sin(scene.surroundings.pitch)])
        for item in scene.objects:
            assert (placed(CUBE, item) @ up).min() == pytest.approx(np.array(scene.surroundings.ground) @ up)
        first, *copies = scene.objects
        for copy in copies:
            shift = np.subtract(copy.position, first.position)
            aside = shift - (shift @ up) * up
            assert (placed(CUBE, first) @ aside).max() <= (placed(CUBE, copy) @ aside).min() + 1e-9, (
                "a plane is between them"
            )


def test_blender_shows_each_copy_where_its_rays_are_and_none_in_a_scene_without(of_mesh: MakeSpec) -> None:
    spec = of_mesh(copies=3, sensor_size=64, f_range=(120.0, 120.0), looks="varied")
    renderer = Renderer(Settings(samples=1, denoised=False, points=1), spec)
    shown = 0
    for index in range(4):
        whole = sample_object_scene(spec, "train", index, renderer.meshes)
        for scene in (whole, whole.model_copy(update={"objects": whole.objects[:1]})):
            hit = trace_pixels(scene, renderer.meshes).first != NOTHING
            assert ((renderer.render(scene)[..., 3] > 0.5) != hit).sum() <= 6
            shown += int(hit.sum()) * (1 if scene is whole else -1)
    assert shown > 200, "pixels that only copies cover"

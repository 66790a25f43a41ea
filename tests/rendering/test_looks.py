"""Varied looks: random surfaces and light, which change neither where things are nor the next image."""

from pathlib import Path

import numpy as np
import pytest

from phd_exp.records.scenes import PATTERNS, Scene
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.blender import Renderer, Settings
from phd_exp.rendering.objects import sample_object_scene
from phd_exp.rendering.rays import NOTHING, trace_pixels
from phd_exp.rendering.samples import fast_settings, front_light, make_sample
from phd_exp.rendering.triangles import Triangles
from tests.support.meshes import solid, write_mesh
from tests.support.renders import SMALL_MESH, MakeSpec, drawn

ONE_SAMPLE = Settings(samples=1, denoised=False, points=1)


@pytest.fixture(scope="module")
def spec(of_mesh: MakeSpec) -> DatasetSpec:
    return of_mesh(looks="varied", distractors=3, sensor_size=56, f_range=(300.0, 500.0))


def test_every_object_has_a_look_and_objects_stay_where_they_are(
    spec: DatasetSpec, meshes: dict[str, Triangles]
) -> None:
    scenes = drawn(spec, 40, meshes)
    plain = drawn(spec.model_copy(update={"looks": "plain"}), 40, meshes)
    looks = [item.look for scene in scenes for item in scene.objects]
    assert {look.pattern for look in looks} == set(PATTERNS)
    assert 0.3 < np.mean([bool(scene.lamps) for scene in scenes]) < 0.7
    values = np.array([max(item.colour) for scene in scenes for item in scene.objects])
    assert (values.min() < 0.15, values.max() > 0.9) == (True, True)
    for scene, before in zip(scenes, plain, strict=True):
        assert scene.objects[0].position == before.objects[0].position
        assert Scene.model_validate_json(scene.model_dump_json()) == scene
        assert "look" not in before.model_dump_json()


def test_an_image_depends_on_its_scene_alone(spec: DatasetSpec) -> None:
    """Materials, lamps and samples of the image before are gone; silhouettes are where the labels are."""
    fast = spec.model_copy(update={"samples_per_pixel": 1})
    renderer = Renderer(fast_settings(fast), fast)
    scenes = drawn(fast, 5, renderer.meshes)
    assert {any(item.look.metallic for item in scene.objects) for scene in scenes} == {True, False}
    images = [make_sample(renderer, fast, "train", index)[0] for index in range(5)]
    for index, scene in reversed(list(enumerate(scenes))):
        assert make_sample(renderer, fast, "train", index)[0] == images[index]
        hits = trace_pixels(scene, renderer.meshes)
        opacity = front_light(renderer, scene, hits)[..., 3] > 0.5
        assert (opacity != (hits.first != NOTHING)).mean() < 0.02


def test_a_texture_changes_its_tone(of_mesh: MakeSpec, tmp_path: Path) -> None:
    file = write_mesh(tmp_path / "part.obj", solid("cube"))
    file.write_text("mtllib part.mtl\n" + file.read_text().replace("f ", "usemtl red\nf ", 1))
    (tmp_path / "part.mtl").write_text("newmtl red\nKd 0.5 0.1 0.1\n")
    spec = of_mesh(mesh=str(file), looks="varied", **SMALL_MESH)
    renderer = Renderer(ONE_SAMPLE, spec)
    scene = sample_object_scene(spec, "train", 0, renderer.meshes)
    item = scene.objects[0]
    dark, bright = (
        renderer.render(scene.model_copy(update={"objects": (item.model_copy(update={"look": look}),)}))[28, 28, :3]
        for look in (item.look.model_copy(update={"value": value}) for value in (0.5, 1.0))
    )
    np.testing.assert_allclose(dark[0] / bright[0], 0.5, atol=0.15)

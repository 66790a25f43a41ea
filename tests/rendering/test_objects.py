"""Scenes of a mesh: its size, pose and surroundings, and its silhouette against geometry and Blender."""

import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy import stats

from phd_exp.records.scenes import Pose, Scene, Surroundings
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.antialias import coverage
from phd_exp.rendering.blender import Renderer, Settings, load_bpy
from phd_exp.rendering.objects import REACH, sample_object_scene, upright_rotation
from phd_exp.rendering.pixels import Box
from phd_exp.rendering.rays import cylinder_mask, rotation_matrix, trace_pixels, truncation, visibility
from phd_exp.rendering.render import by_sky
from phd_exp.rendering.samples import fast_settings, make_sample, shadow, unmixed
from phd_exp.rendering.sampling import about_axis, sample_scene
from phd_exp.rendering.surroundings import photo_light, shaken
from phd_exp.rendering.triangles import Triangles
from tests.support.meshes import solid, write_mesh
from tests.support.renders import UNLIKELY, MakeSpec, decoded, drawn

SKIES = {"night", "city", "interior", "forest", "studio", "sunset", "sunrise", "courtyard"}
AT_MIDDLES = Settings(samples=1, denoised=False, points=1)


@pytest.fixture(scope="module")
def meshes(meshes: dict[str, Triangles]) -> dict[str, Triangles]:
    return meshes | {"mesh1": solid("cube", 0.1)}


def test_a_cylinder_as_a_mesh_is_the_analytic_cylinder(of_mesh: MakeSpec, meshes: dict[str, Triangles]) -> None:
    """The scenes are paired; silhouettes differ by at most 5 pixels, so visibility and truncation agree."""
    spec, cut = of_mesh(), 0
    for index in range(30):
        plain, scene = sample_scene(spec, "train", index), sample_object_scene(spec, "train", index, meshes)
        paired = ("position", "rotation", "scale", "colour", "material")
        assert [getattr(scene.objects[0], key) for key in paired] == [
            getattr(plain.objects[0], key) for key in paired
        ]
        hits, exact = trace_pixels(scene, meshes), trace_pixels(plain)
        mask = cylinder_mask(exact)
        assert (cylinder_mask(hits) != mask).sum() <= 5
        assert truncation(scene, hits, meshes) == pytest.approx(truncation(plain, exact), abs=10 / mask.sum())
        both = mask & cylinder_mask(hits)
        error = np.abs(hits.depths[0][both] - exact.depths[0][both])
        assert np.quantile(error, 0.99) < 1e-3, "except where rays graze"
        cut += truncation(scene, hits, meshes) > 0
    assert cut > 3


def test_depths_are_those_of_rays(meshes: dict[str, Triangles]) -> None:
    """A cube's depth in its local frame, from slabs; both are exact."""
    turn = rotation_matrix((0.5, 0.5, -0.5, 0.5)) @ rotation_matrix((0.8, 0.0, 0.6, 0.0))
    depths = solid("cube").depths(turn, np.array([0.02, -0.01, 1.0]), f=300.0, S=101)
    rays = np.stack([*np.meshgrid(*(2 * [(np.arange(101) - 50) / 300.0])), np.ones((101, 101))], axis=-1) @ turn
    origin = -turn.T @ np.array([0.02, -0.01, 1.0])
    with np.errstate(divide="ignore"):
        one, two = (-0.1 - origin) / rays, (0.1 - origin) / rays
    enter, leave = np.minimum(one, two).max(axis=-1), np.maximum(one, two).min(axis=-1)
    np.testing.assert_allclose(depths, np.where(enter <= leave, enter, np.inf), rtol=1e-9)
    assert 2000 < np.isfinite(depths).sum() < 9000


def test_an_upright_object_is_only_turned_about_the_vertical(of_mesh: MakeSpec, meshes: dict[str, Triangles]) -> None:
    scenes = drawn(of_mesh(upright=True, ground=True, pitch_range=(10.0, 40.0)), 300, meshes)
    pitches, turns = [], []
    for scene in scenes:
        assert scene.surroundings is not None
        pitch, item = scene.surroundings.pitch, scene.objects[0]
        up = np.array([0.0, -np.cos(pitch), -np.sin(pitch)])
        assert rotation_matrix(item.rotation)[:, 2] == pytest.approx(up)
        level = rotation_matrix(item.rotation)[:, 0]
        turns.append(np.arctan2(level[0], level @ np.cross([1.0, 0.0, 0.0], up)) % (2 * np.pi))
        pitches.append(np.degrees(pitch))
        assert np.array(scene.surroundings.ground) == pytest.approx(np.array(item.position) - 0.1 * up)
        assert np.array(scene.surroundings.ground) @ up < 0, "below the camera"
    assert stats.kstest(pitches, stats.uniform(10, 30).cdf).pvalue > UNLIKELY
    assert stats.kstest(turns, stats.uniform(0, 2 * np.pi).cdf).pvalue > UNLIKELY
    assert rotation_matrix(upright_rotation(0.0, 0.0))[:, 2] == pytest.approx([0, -1, 0])


def test_test_images_have_other_skies_and_skies_replace_the_lamps(
    of_mesh: MakeSpec, meshes: dict[str, Triangles]
) -> None:
    spec = of_mesh()
    files = {
        split: {scene.surroundings.file for scene in drawn(spec, 100, meshes, split)} for split in ("train", "test")
    }
    assert (len(files["train"]), len(files["test"])) == (6, 2)
    assert files["train"] | files["test"] == SKIES
    assert all(scene.lamps == () for scene in drawn(spec, 5, meshes))
    assert all(len(scene.lamps) == 3 for scene in drawn(of_mesh(backdrops=None), 5, meshes))
    assert drawn(spec, 5, meshes) == drawn(spec, 5, meshes)


def test_photographs_are_split_by_file(of_mesh: MakeSpec, meshes: dict[str, Triangles], tmp_path: Path) -> None:
    for number in range(9):
        (tmp_path / f"{number}.{'exr' if number == 5 else 'jpg'}").write_bytes(bytes([number]))
    spec = of_mesh(backdrops=str(tmp_path))
    scenes = {split: drawn(spec, 200, meshes, split) for split in ("train", "test")}
    names = {split: {scene.surroundings.file for scene in found} for split, found in scenes.items()}
    assert names == {"test": {"3.jpg", "7.jpg"}, "train": {f"{k}.jpg" for k in (0, 1, 2, 4, 6, 8)} | {"5.exr"}}
    assert all(
        scene.surroundings.is_sky == (scene.lamps == ()) == (scene.surroundings.file == "5.exr")
        for scene in scenes["train"]
    )
    (tmp_path / "0.jpg").write_bytes(b"another")
    assert of_mesh(backdrops=str(tmp_path)).fingerprint() != spec.fingerprint()


def around(**changes: Any) -> Surroundings:
    plain = {
        "pitch": 0,
        "file": "a.png",
        "is_sky": False,
        "turn": 0,
        "brightness": 1,
        "ground": None,
        "shake": (0, 0),
        "span": 1,
    }
    return Surroundings(**{**plain, "square": (0.5, 0.0, 0.5), "flipped": False, **changes})


def test_a_photograph_is_cropped_and_flipped(tmp_path: Path) -> None:
    ramp = np.broadcast_to(np.arange(256, dtype=np.uint8), (64, 256))
    Image.fromarray(ramp).save(tmp_path / "a.png")
    light = photo_light(tmp_path / "a.png", around(), 16)  # columns 112 to 144
    assert light.shape == (16, 16, 3)
    middles = 112 + 2 * np.arange(16) + 0.5
    assert light[3, :, 1] == pytest.approx(((middles / 255 + 0.055) / 1.055) ** 2.4, abs=0.005)
    assert photo_light(tmp_path / "a.png", around(flipped=True), 16) == pytest.approx(light[:, ::-1])


def test_a_shaken_image_is_a_mean_along_the_path() -> None:
    light = np.zeros((33, 33, 3))
    light[16, 16] = 1.0
    moved = shaken(light, (6.0, 3.0))
    rows, columns = np.mgrid[:33, :33]
    for axis, length in ((rows, 3.0), (columns, 6.0)):
        mean = (moved[..., 0] * axis).sum()
        assert (moved[..., 0].sum(), mean) == pytest.approx((1.0, 16.0))
        assert (moved[..., 0] * (axis - mean) ** 2).sum() == pytest.approx(length**2 / 12, abs=0.25)
    assert shaken(light, (0.0, 0.0)) is light


def test_distractors_are_other_objects_each_once(of_mesh: MakeSpec, meshes: dict[str, Triangles]) -> None:
    plain = of_mesh()
    spec = plain.model_copy(update={"distractors": 3})
    seen = set()
    for scene, alone in zip(drawn(spec, 20, meshes), drawn(plain, 20, meshes), strict=True):
        names = [item.shape for item in scene.objects]
        assert (names[0], len(set(names))) == ("mesh", 4)
        assert scene.model_copy(update={"objects": scene.objects[:1]}) == alone, "paired"
        seen |= set(names)
    assert seen == {"mesh", "mesh1", "cylinder", "cube", "sphere"}
    for side in (0.2, 0.4):
        (scene,) = drawn(spec.model_copy(update={"distractors": 1}), 1, {"mesh": solid("cylinder", side)})
        assert scene.objects[1].dimensions == pytest.approx([side] * 3), "as large as the object"
    narrow = drawn(spec.model_copy(update={"xy_range": 0.0}), 20, meshes)
    spread = np.array([[item.position[0] / item.position[2] * scene.f for item in scene.objects] for scene in narrow])
    assert not spread[:, 0].any(), "the object is in the middle"
    assert 0.3 < np.abs(spread[:, 1:]).max() / spec.sensor_size < 0.5, "and the others anywhere"
    hidden = plain.model_copy(update={"half_hidden": True})
    shares = [visibility(trace_pixels(scene, meshes)) for scene in drawn(hidden, 20, meshes)]
    whole = [truncation(scene, trace_pixels(scene, meshes), meshes) == 0 for scene in drawn(hidden, 20, meshes)]
    np.testing.assert_allclose(np.array(shares)[whole], 0.5, atol=0.13)
    double = {"mesh": solid("cylinder", 0.4)}
    for small, large in zip(drawn(hidden, 9, meshes), drawn(hidden, 9, double), strict=True):
        assert np.array(large.objects[1].dimensions) == pytest.approx(2 * np.array(small.objects[1].dimensions))
    assert meshes["mesh"].radius == pytest.approx(REACH)


def test_records_of_cylinders_stay_as_they_were(
    make_spec: MakeSpec, of_mesh: MakeSpec, meshes: dict[str, Triangles]
) -> None:
    plain = make_spec()
    assert "surroundings" not in sample_scene(plain, "train", 0).model_dump_json()
    assert not {"mesh", "unit", "backdrops"} & plain.model_dump().keys()
    scene = drawn(of_mesh(), 1, meshes)[0]
    assert Scene.model_validate_json(scene.model_dump_json()) == scene
    spec = of_mesh()
    stored = DatasetSpec.model_validate_json(spec.model_dump_json())
    assert (stored, stored.fingerprint()) == (spec, spec.fingerprint())
    with pytest.raises(ValueError, match="no record says where part"):
        stored.mesh.path("part.stl")


@pytest.fixture(scope="module")
def under_a_sky(of_mesh: MakeSpec) -> tuple[Renderer, Scene]:
    """A renderer without denoiser, and a scene whose object is in the middle."""
    spec = of_mesh(sensor_size=32, f_range=(60.0, 60.0), xy_range=0.0)
    renderer = Renderer(Settings(samples=1024, denoised=False, points=None), spec)
    return renderer, sample_object_scene(spec, "train", 0, renderer.meshes)


def changed(scene: Scene, f: float = 60.0, pose: Pose | None = None, **changes: Any) -> Scene:
    """A scene under the sky `city`, in its true size, with changes of the surroundings."""
    seen = scene.surroundings.model_copy(update={"file": "city", "span": 1.0} | changes)
    return scene.model_copy(update={"surroundings": seen, "f": f, "pose": pose or scene.pose})


AWAY = Pose(rotation=about_axis((0.6, 0.8, 0.0), 1.0), translation=(0.0, 0.0, 0.0))  # as a further view turns


@pytest.mark.parametrize("pose", [None, AWAY])
def test_a_sky_is_looked_up_as_it_is_traced(under_a_sky: tuple[Renderer, Scene], pose: Pose | None) -> None:
    renderer, scene = under_a_sky
    empty = changed(scene, pose=pose, pitch=0.4).model_copy(update={"objects": (), "lamps": ()})
    film = load_bpy().context.scene.render
    film.film_transparent = False
    try:
        traced = renderer.render(empty)
    finally:
        film.film_transparent = True
    light = renderer.sky(empty)
    assert (traced[..., 3] == 1).all()
    np.testing.assert_allclose(light, traced[..., :3], rtol=0.07, atol=0.01)
    assert light.std() > 0.1 * light.mean()


def test_skies_light_the_scene_and_turn_with_the_camera(under_a_sky: tuple[Renderer, Scene]) -> None:
    """A camera that looks down sees what a panorama has below; a brighter sky lights more."""
    renderer, scene = under_a_sky
    plain, bright = (changed(scene, file="sunrise", brightness=factor) for factor in (1.0, 2.0))
    for paint in (renderer.render, renderer.sky):
        np.testing.assert_allclose(paint(bright)[..., :3], 2 * paint(plain)[..., :3], rtol=1e-3, atol=1e-3)
    assert renderer.render(plain)[16, 16, :3].min() > 0.01
    panorama = load_bpy().data.images["sunrise.exr"]
    rows = np.array(panorama.pixels[:]).reshape(512, 1024, 4)[..., :3].mean(axis=(1, 2))
    for pitch, half in ((np.pi / 2, rows[:128]), (-np.pi / 2, rows[-128:])):
        shown = renderer.sky(changed(scene, f=40.0, file="sunrise", pitch=pitch, brightness=1.0)).mean()
        assert half.min() <= shown <= half.max()


def test_a_sky_spans_a_wider_field_but_lights_from_where_it_is(
    under_a_sky: tuple[Renderer, Scene], of_mesh: MakeSpec
) -> None:
    """Behind the object is what a lens of that much shorter focal length shows; the object's light is the same."""
    renderer, scene = under_a_sky
    for pose in (None, AWAY):
        wide, short = changed(scene, span=4.0, pose=pose), changed(scene, f=15.0, pose=pose)
        np.testing.assert_array_equal(renderer.sky(wide), renderer.sky(short))
    narrow = changed(scene)
    np.testing.assert_array_equal(renderer.render(changed(scene, span=4.0)), renderer.render(narrow))
    assert np.abs(renderer.sky(changed(scene, span=4.0)) - renderer.sky(narrow)).mean() > 0.05
    spans = np.log([one.surroundings.span for one in drawn(of_mesh(), 300, renderer.meshes)]) / np.log(8)
    assert stats.kstest(spans, "uniform").pvalue > UNLIKELY


def test_computed_edges_are_those_of_the_tracer(under_a_sky: tuple[Renderer, Scene]) -> None:
    renderer, scene = under_a_sky
    near = changed(scene, f=300.0)
    box = Box(2, 3, 30, 31)
    computed, traced = coverage(near, box, renderer.meshes), renderer.render(near, box)[..., 3:]
    assert ((traced > 0.1) & (traced < 0.9)).sum() > 20, "there are edges"
    assert np.abs(computed - traced).max() < 0.2, "of random points"
    assert np.abs(computed - traced)[(traced > 0) & (traced < 1)].mean() < 0.04


def test_points_of_pixels_have_the_mean_of_the_filter(of_mesh: MakeSpec) -> None:
    """Along edges, as random points have; in any box, which may touch the borders of the image."""
    spec = of_mesh(sensor_size=32, f_range=(450.0, 450.0), xy_range=0.0)
    exact = Renderer(Settings(samples=256, denoised=False, points=None), spec)
    scene = sample_object_scene(spec, "train", 0, exact.meshes)
    traced = exact.render(scene)[..., 3]
    ours = Renderer(Settings(samples=1, denoised=False, points=2), spec)
    computed, part = ours.render(scene)[..., 3], ours.render(scene, Box(0, 3, 30, 32))[..., 3]
    assert traced[:, 0].any() or traced[0].any(), "the object touches the borders"
    assert ((traced > 0.1) & (traced < 0.9)).sum() > 20, "there are edges"
    assert np.abs(computed - traced).max() < 0.15
    assert np.abs(computed - traced)[(traced > 0) & (traced < 1)].mean() < 0.03
    np.testing.assert_allclose(part, computed[3:32, :30], atol=1e-6)


def test_the_light_of_a_surface_does_not_depend_on_the_share_of_the_pixel_that_it_covers() -> None:
    """Two surfaces, of light 0.2 and 0.6; rays found 0.1 % of the pixels around them, and light of others."""
    surface = np.repeat([0.2, 0.6], 8)[None, :, None] * np.ones((12, 1, 3))
    opacity = np.full((12, 16, 1), 1e-3)
    opacity[3:9] = 1.0
    opacity[2], opacity[9] = 0.7, 0.3
    front = opacity * surface + np.where(opacity < 0.5, 0.01, 0.0)
    light = unmixed(front, opacity)
    far = np.r_[:6, 10:16]  # from the border between both, within whose reach they are averaged
    np.testing.assert_allclose(light[1:11, far], surface[1:11, far])
    assert (unmixed(0 * front, 0 * opacity) == 0).all()
    thin = np.where(np.arange(16)[:, None] == 8, 0.1, 0.0) * np.ones((12, 1, 1))
    np.testing.assert_allclose(unmixed(0.4 * np.repeat(thin, 3, axis=2), thin)[:, 7:10], 0.4)


def test_the_ground_has_a_shadow_below_the_object(of_mesh: MakeSpec) -> None:
    """Its layer shows it without the objects; a scene without an object has no shadow."""
    spec = of_mesh(sensor_size=48, f_range=(300.0, 300.0), upright=True, ground=True, pitch_range=(30.0, 31.0))
    renderer = Renderer(Settings(samples=16, denoised=False, points=None), spec)
    scene = sample_object_scene(spec, "train", 3, renderer.meshes)
    dark = shadow(renderer, scene)[..., 0]
    shown = cylinder_mask(trace_pixels(scene, renderer.meshes))
    assert dark[shown].max() > 0.4
    assert dark[:6].mean() < 0.1
    assert np.abs(shadow(renderer, scene.model_copy(update={"objects": ()}))).max() < 0.01
    opacity = renderer.render(scene)[..., 3]
    assert ((opacity > 0.5) != shown).sum() <= 10, "the ground is not on the layer of the objects"


def test_samples_under_the_same_sky_follow_each_other(of_mesh: MakeSpec, meshes: dict[str, Triangles]) -> None:
    spec, samples = of_mesh(), [("train", index) for index in range(200)]
    ordered = by_sky(spec, samples)
    assert sorted(ordered[:128]) == samples[:128]
    assert sorted(ordered) == samples
    files = [sample_object_scene(spec, split, index, meshes).surroundings.file for split, index in ordered]
    assert sum(one != other for one, other in pairwise(files)) <= 2 * 6
    assert by_sky(of_mesh(backdrops=None), samples) == samples


def test_a_glowing_material_does_not_depend_on_the_sky(make_spec: MakeSpec, tmp_path: Path) -> None:
    file = write_mesh(tmp_path / "part.obj", solid("cube"))
    file.write_text("mtllib part.mtl\n" + file.read_text().replace("f ", "usemtl lamp\nf ", 1))
    (tmp_path / "part.mtl").write_text("newmtl lamp\nKd 0 0 0\nKs 0 0 0\nKe 0 3 0\n")
    spec = make_spec("object", mesh=str(file), sensor_size=32, f_range=(300.0, 300.0), xy_range=0.0)
    renderer = Renderer(AT_MIDDLES, spec)
    scene = sample_object_scene(spec, "train", 0, renderer.meshes)
    dim, bright = (renderer.render(changed(scene, 300.0, brightness=value))[16, 16] for value in (0.5, 2.0))
    assert (dim[1], bright[1]) == (pytest.approx(3, rel=0.1), pytest.approx(3, rel=0.3))


@pytest.mark.slow
def test_thirty_thousand_faces_take_a_sixtieth_of_1024_samples_at_38_decibels(
    make_spec: MakeSpec, tmp_path: Path
) -> None:
    """In processor time of this run: seconds would depend on the machine."""
    file = write_mesh(tmp_path / "ball.ply", solid("sphere"))
    spec = make_spec("object", mesh=str(file), xy_range=0.5)
    renderer = Renderer(fast_settings(spec), spec)
    assert len(renderer.meshes["mesh"].corners) >= 30_000
    make_sample(renderer, spec, "train", 9)  # compiles and loads

    def made(by: Renderer) -> tuple[list[np.ndarray], float]:
        """Two images and their processor time."""
        begun = time.process_time()
        images = [decoded(make_sample(by, spec, "train", index)[0]).astype(float) for index in (0, 1)]
        return images, time.process_time() - begun

    ours, seconds = made(renderer)
    exact, longer = made(Renderer(Settings(samples=1024, denoised=False, points=None), spec))
    decibels = [-10 * np.log10(np.mean((a - b) ** 2) / 255**2) for a, b in zip(ours, exact, strict=True)]
    print(f"{seconds / 2:.2f} s, 1/{longer / seconds:.0f}, {decibels} dB")
    assert longer / seconds >= 60
    assert min(decibels) >= 38

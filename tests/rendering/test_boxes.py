"""Views of a detector's boxes: the box, the view and the labels against the geometry of the user's image."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy import stats

from phd_exp.data.crops import cut
from phd_exp.optics.virtual import VirtualCamera
from phd_exp.records.cameras import calibration
from phd_exp.records.errors import gist
from phd_exp.records.scenes import Scene
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.blender import Renderer, Settings
from phd_exp.rendering.boxes import view_of_box
from phd_exp.rendering.objects import sample_object_scene
from phd_exp.rendering.rays import NOTHING, beyond_edges, in_camera_frame, rotation_matrix, trace_pixels
from phd_exp.rendering.samples import GREY, make_sample, photograph
from phd_exp.rendering.sampling import sample_scene
from phd_exp.rendering.triangles import Triangles
from tests.support.meshes import placed
from tests.support.renders import UNLIKELY, MakeSpec, decoded, drawn

SIZE = {"width": 640, "height": 480, "K": (530.0, 0, 340, 0, 532.0, 236, 0, 0, 1)}
CAMERA = SIZE | {"D": (-0.28, 0.03, 0.001, 0.0, 0.1), "model": "plumb_bob"}
FISHEYE = CAMERA | {"D": (-0.03, 0.004, -0.002, 0.0003), "model": "equidistant"}
EXACT: dict[str, Any] = {"box_size": (1.0, 1.0), "box_shift": 0.0}


@pytest.fixture(scope="module")
def of_box(of_mesh: MakeSpec) -> MakeSpec:
    """The data set of views of boxes of a cylinder of 0.2 m, with some values changed."""
    return lambda **changes: of_mesh(**{"camera": CAMERA, "z_range": (0.5, 1.5)} | changes)


def outline(scene: Scene, mesh: Triangles) -> np.ndarray:
    """The vertices of the object in the user's image, px."""
    item, camera = scene.objects[0], scene.real_camera
    distorted = camera.lens.distort(placed(mesh, item))
    return camera.intrinsics[:2, 2] + np.diagonal(camera.intrinsics)[:2] * distorted


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE], ids=["radial", "fisheye"])
def test_the_box_is_that_of_the_silhouette_in_the_distorted_image(
    of_box: MakeSpec, meshes: dict[str, Triangles], camera: dict[str, Any]
) -> None:
    for scene in drawn(of_box(camera=camera, xy_range=0.6, **EXACT), 12, meshes):
        points = outline(scene, meshes["mesh"])
        expected = np.array([*points.min(0), *points.max(0)])
        side = (expected[2:] - expected[:2]).max()
        np.testing.assert_allclose(scene.real_box, expected, atol=0.012 * side)


def test_the_view_is_that_of_predict_and_the_label_belongs_to_it(
    of_box: MakeSpec, meshes: dict[str, Triangles]
) -> None:
    spec, depths = of_box(), []
    for scene in drawn(spec, 20, meshes):
        camera = VirtualCamera.of_box(
            scene.real_camera.intrinsics, scene.real_box, float(scene.S), scene.real_camera.lens
        )
        assert scene.f == pytest.approx(camera.f)
        np.testing.assert_allclose(rotation_matrix(scene.pose.rotation), camera.R, atol=1e-12)
        real = np.array(scene.objects[0].position)
        np.testing.assert_allclose(in_camera_frame(real, scene.pose), camera.to_virtual(real), atol=1e-12)
        depths.append(real[2])
    assert 0.5 < min(depths) < max(depths) < 1.5


def test_a_view_shows_what_the_crop_of_a_whole_photograph_shows(of_box: MakeSpec) -> None:
    """Light and noise aside: a scene rendered in the view of a box, and the view of that box in a large render."""
    camera = {"f": 500.0, "width": 448, "height": 448}
    changes: dict[str, Any] = {"camera": camera, "xy_range": 0.5, "backdrops": None, "samples_per_pixel": 8}
    whole, box = of_box(view="field", sensor_size=448, **changes), of_box(sensor_size=96, **changes)
    renderer = Renderer(Settings(samples=16, denoised=True, points=None), whole)
    scene = sample_object_scene(whole, "train", 3, renderer.meshes)
    view = view_of_box(scene.model_copy(update={"S": 96}), box, np.random.default_rng(0), renderer.meshes)
    assert view is not None
    K = calibration(camera).intrinsics
    blank = {"level": 0.6, "falloff": 0.0}  # the backdrop belongs to the image, not to the scene
    plain = [one.model_copy(update={"backdrop": one.backdrop.model_copy(update=blank)}) for one in (scene, view)]
    pictures = [
        photograph(renderer, one, trace_pixels(one, renderer.meshes), spec)
        for one, spec in zip(plain, (whole, box), strict=True)
    ]
    seen = cut(Image.fromarray(pictures[0]), VirtualCamera.of_box(K, view.real_box, 96.0))
    drawn_directly = pictures[1]
    assert np.abs(seen.astype(float) - drawn_directly).mean() < 3
    assert drawn_directly.std() > 20


def test_the_apparent_size_is_nearly_constant(of_box: MakeSpec, meshes: dict[str, Triangles]) -> None:
    """What the network learns is what the box does not say."""
    scenes = drawn(of_box(xy_range=0.3, **EXACT), 30, meshes)
    size = np.array([in_camera_frame(np.array(s.objects[0].position), s.pose)[2] / s.f for s in scenes])
    depth = np.array([s.objects[0].position[2] for s in scenes])
    assert depth.max() / depth.min() > 2.5
    assert size.max() / size.min() < 1.6, "a cylinder's box has one to 1.4 times its side, and perspective"
    jittered = drawn(of_box(xy_range=0.3, box_size=(0.9, 1.5)), 30, meshes)
    sides = [np.diff(np.array(s.real_box).reshape(2, 2), axis=0).max() for s in jittered]
    exact = [np.ptp(outline(s, meshes["mesh"]), axis=0).max() for s in jittered]
    ratio = np.array(sides) / exact
    assert (0.88 < ratio.min() < 1.0, 1.4 < ratio.max() < 1.53) == (True, True)


@pytest.mark.parametrize("distance", [0.5, 0.0, -0.5])
def test_reference_points_keep_their_distance_from_the_edges(
    of_box: MakeSpec, meshes: dict[str, Triangles], distance: float
) -> None:
    """They are uniform in a part of the image, or, if the distance is negative, in a larger rectangle."""
    camera = {"f": 500.0, "width": 400, "height": 300}
    spec = of_box(camera=camera, z_range=(0.3, 0.6), xy_range=0.8, edge_distance=distance)
    inside = []
    for index in range(400):
        item = sample_scene(spec, "train", index, meshes["mesh"].radius).objects[0]
        x, y, z = item.position
        room = np.array([400, 300]) - 2 * distance * 500 * meshes["mesh"].radius / z
        inside.append(np.array([x, y]) / z * 500 / room)
    across, down = np.array(inside).T
    for places in (across, down):
        assert stats.kstest(places, stats.uniform(-0.4, 0.8).cdf).pvalue > UNLIKELY


def test_an_object_larger_than_the_image_is_in_its_middle(of_box: MakeSpec) -> None:
    spec = of_box(camera={"f": 500.0, "width": 400, "height": 300})
    assert sample_scene(spec, "train", 0, radius=10.0).objects[0].position[:2] == (0.0, 0.0)


def test_what_lies_beyond_the_edges_is_grey_and_not_labelled(of_box: MakeSpec, tmp_path: Path) -> None:
    spec = of_box(sensor_size=56, samples_per_pixel=1, backdrops=None)
    renderer = Renderer(Settings(samples=1, denoised=False, points=None), spec)
    scenes = drawn(spec, 20, renderer.meshes)
    first = next(index for index, scene in enumerate(scenes) if beyond_edges(scene).any())
    content, record = make_sample(renderer, spec, "train", first)
    outside = beyond_edges(record.as_scene)
    image = decoded(content)
    assert (image[outside] == GREY).all()
    assert not (image[~outside] == GREY).all()
    assert (trace_pixels(record.as_scene, renderer.meshes).first[outside] == NOTHING).all()
    assert record.real_camera is not None


@pytest.mark.parametrize("z_range", [(0.15, 0.16), (0.5, 1.5), (3000.0, 5000.0)], ids=str)
def test_blender_draws_at_any_distance_where_the_labels_are(of_box: MakeSpec, z_range: tuple[float, float]) -> None:
    """Of an object that is lit by lamps alone; silhouettes differ in a few pixels of their outlines."""
    f = 530.0 if z_range[0] < 10 else 3e6
    camera = {"f": f, "width": 640, "height": 480}
    spec = of_box(camera=camera, z_range=z_range, backdrops=None, sensor_size=64, distractors=0, xy_range=0.2)
    renderer = Renderer(Settings(samples=1, denoised=False, points=1), spec)
    for scene in drawn(spec, 3, renderer.meshes):
        opacity = renderer.render(scene)[..., 3] > 0.5
        mask = trace_pixels(scene, renderer.meshes).first != NOTHING
        assert mask.sum() > 500
        assert ((opacity != mask) & ~beyond_edges(scene)).mean() < 0.02


@pytest.mark.parametrize("front", [(2.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)], ids=str)
def test_the_front_faces_the_camera(of_box: MakeSpec, meshes: dict[str, Triangles], front: tuple[float, ...]) -> None:
    """An STL has Blender's axes; the object turns freely about its front."""
    angles, across = [], []
    for scene in drawn(of_box(front=front, front_range=(20.0, 50.0)), 40, meshes):
        item = scene.objects[0]
        turn, way = rotation_matrix(item.rotation), -np.array(item.position)
        angles.append(np.degrees(np.arccos(turn @ front @ way / np.linalg.norm(way) / np.linalg.norm(front))))
        across.append(turn[:, 1])
    assert 20 <= min(angles) < 27
    assert 45 < max(angles) <= 50
    assert np.abs(np.mean(across, axis=0)).max() < 0.4


def test_grey_images_are_grey(of_box: MakeSpec) -> None:
    spec = of_box(grey=True, sensor_size=32, samples_per_pixel=1)
    renderer = Renderer(Settings(samples=1, denoised=False, points=None), spec)
    image = decoded(make_sample(renderer, spec, "train", 0)[0])
    assert (image == image[..., :1]).all()
    assert image.std() > 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"camera": None, "view": "box"}, "view: got box; expected data.camera=FILE"),
        ({"f_range": (300.0, 400.0)}, "f_range: .* follows from data.camera; leave it out"),
        ({"f_range": (1200.0, 2000.0)}, "f_range: .* follows from data.camera; leave it out"),
        ({"camera": CAMERA | {"width": None}}, "camera: .* does not say the size"),
        ({"camera": {"f": 18.0, "width": 4000, "height": 3000}}, "shows 179 degrees; .* f in millimetres"),
        ({"camera": "nowhere.yaml"}, "camera: nowhere.yaml: .*No such file"),
        ({"view": "field", "box_shift": 0.1}, "box_shift: got view=field; expected view=box"),
        ({"view": "field", "edge_distance": 0.0}, "edge_distance: got view=field; expected view=box"),
        ({"front_range": (0.0, 60.0)}, "front: expected a direction"),
        ({"views": 2}, "views: got 2 with view=box; expected 1"),
        ({"camera": None, "views": 2, "copies": 1}, "views: got 2 with distractors or copies; expected 1"),
    ],
    ids=str,
)
def test_a_camera_that_does_not_fit_is_one_line(of_box: MakeSpec, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as error:
        of_box(**changes)
    assert "\n" not in gist(error.value)


def test_the_whole_image_of_a_camera_decides_the_focal_length(of_box: MakeSpec) -> None:
    plain = {"f": 900.0, "width": 640, "height": 480}
    spec = of_box(camera=plain, view="field")
    assert spec.f_range == pytest.approx((900 * 224 / 640,) * 2)
    assert of_box(camera=None).f_range == (1200.0, 2000.0)
    assert (spec.xy_range, of_box(camera=plain).xy_range) == (0.5, 1.0)
    assert calibration(plain) == spec.camera
    assert DatasetSpec.model_validate_json(spec.model_dump_json()) == spec

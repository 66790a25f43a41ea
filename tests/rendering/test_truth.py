"""The labels tell what Blender itself draws: each object's pixels, counted by ray casting and by the renderer."""

from collections.abc import Callable
from typing import get_args

import numpy as np
import pytest

from phd_exp.records.scenes import Scene, Shape
from phd_exp.rendering.blender import Renderer, Settings, load_bpy
from phd_exp.rendering.rays import FACES, NOTHING, cylinder_mask, in_camera_frame, trace_pixels, visibility
from phd_exp.rendering.sampling import sample_scene
from tests.support.renders import VARIANTS, MakeSpec, with_objects

SHAPES = get_args(Shape)
# Meshes are polygons, up to 0.01 px inside their solids: a silhouette of a thousand pixels' length shifts ten.
FEW = 10  # px
EVERY = 5  # takes the views of `multiview` in turn


@pytest.fixture(scope="module")
def drawn() -> Callable[[Scene], np.ndarray]:
    """Blender's own picture of which object shows in each pixel: 0 for none, 1 for the first of SHAPES, and so on."""
    renderer = Renderer(Settings(samples=1, denoised=False, points=1))
    bpy = load_bpy()
    for number, shape in enumerate(SHAPES, start=1):
        bpy.data.objects[shape].pass_index = number
    for material in bpy.data.materials:
        shine_with_number(material.node_tree)
    bpy.context.scene.world = None

    def draw(scene: Scene) -> np.ndarray:
        light = renderer.render(scene)
        assert np.isin(light, range(len(SHAPES) + 1)).all(), "one object a pixel, nothing mixed"
        return light[..., 0].astype(int)

    return draw


def shine_with_number(tree: object) -> None:
    """Make a material's surface a light as strong as the pass index of the object it is on."""
    nodes, links = tree.nodes, tree.links  # type: ignore[attr-defined]
    nodes.clear()
    info, light, output = (nodes.new(f"ShaderNode{kind}") for kind in ("ObjectInfo", "Emission", "OutputMaterial"))
    light.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    links.new(info.outputs["Object Index"], light.inputs["Strength"])
    links.new(light.outputs["Emission"], output.inputs["Surface"])


def cast(scene: Scene) -> np.ndarray:
    """The same by ray casting."""
    first = trace_pixels(scene).first.astype(int)
    numbers = np.array([0, *(SHAPES.index(item.shape) + 1 for item in scene.objects)])
    return numbers[np.where(first == NOTHING, 0, (first - 1) // FACES + 1)]


def check(scene: Scene, drawn: Callable[[Scene], np.ndarray]) -> None:
    """All that a record says of pixels, against Blender's."""
    hits, numbers, bare = trace_pixels(scene), drawn(scene), drawn(with_objects(scene, scene.objects[0])) == 1
    seen = numbers == 1
    mask, whole = cylinder_mask(hits), hits.surfaces[0] != NOTHING
    assert abs(int(mask.sum()) - int(seen.sum())) <= FEW
    assert abs(int(whole.sum()) - int(bare.sum())) <= FEW
    assert (cast(scene) != numbers).sum() <= FEW * len(scene.objects)
    if bare.any():
        assert visibility(hits) == pytest.approx(seen.sum() / bare.sum(), abs=2 * FEW / bare.sum())
    if seen.sum() >= 100:
        offset = np.argwhere(mask).mean(axis=0) - np.argwhere(seen).mean(axis=0)
        assert np.abs(offset).max() <= 0.05


MANY = [pytest.param(variant, 30, marks=pytest.mark.slow) for variant in (*VARIANTS, "multiview")]


@pytest.mark.parametrize(("variant", "count"), [("occl_scale", 3), ("multiview", 3), *MANY])
def test_labels_are_those_of_blenders_pixels(
    make_spec: MakeSpec, drawn: Callable[[Scene], np.ndarray], variant: str, count: int
) -> None:
    scenes = [sample_scene(make_spec(variant), "train", EVERY * number) for number in range(count)]
    assert any(cylinder_mask(trace_pixels(scene)).sum() >= 100 for scene in scenes)
    for scene in scenes:
        check(scene, drawn)


def test_another_view_is_drawn_from_where_its_pose_says(
    make_spec: MakeSpec, drawn: Callable[[Scene], np.ndarray]
) -> None:
    """A cylinder of two centimetres stands at the projection of its recorded position."""
    spec = make_spec("multiview")
    for index in (1, 2, 3):
        scene = sample_scene(spec, "train", index)
        x, y, z = in_camera_frame(np.array(scene.objects[0].position), scene.pose)
        tiny = scene.objects[0].model_copy(update={"scale": 0.1})
        middle = np.argwhere(drawn(with_objects(scene, tiny)) == 1).mean(axis=0) + 0.5
        assert middle == pytest.approx(scene.f * np.array([y, x]) / z + scene.S / 2, abs=0.5)

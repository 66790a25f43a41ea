"""Blender's scene as a stage: built once, then arranged for one scene after another.

Blender's camera looks along -z with y up, ours along z with y down: p_blender = diag(1, -1, -1) p. Functions receive
Blender's module or its objects; this file does not import it.
"""

from collections.abc import Iterable, Iterator
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from phd_exp.optics.virtual import product, unit
from phd_exp.records.scenes import SHAPES, Backdrop, Lamp, LampName, Material, Scene, SceneObject, Shape
from phd_exp.rendering.looks import show_look
from phd_exp.rendering.meshes import build_mesh
from phd_exp.rendering.pixels import linear
from phd_exp.rendering.rays import rotation_matrix

TO_BLENDER = np.diag([1.0, -1.0, -1.0])
CLIPPING = (0.01, 1000.0)  # m: the depths that the camera shows
SENSOR_WIDTH = 36.0  # mm; arbitrary, because the focal length has the same unit
# Inputs of Principled BSDF. Rubber is matt with a faint sheen; metal reflects the lamps as soft boxes and its
# neighbours as blurs.
SURFACES: dict[Material, dict[str, float]] = {
    "rubber": {"Metallic": 0.0, "Roughness": 0.75, "Specular IOR Level": 0.25},
    "metal": {"Metallic": 1.0, "Roughness": 0.24},
}
# Surroundings that metal reflects and the camera does not show: dim below, brighter above.
SURROUNDINGS = (0.10, 0.75)


def copy_name(shape: str, number: int) -> str:
    """The name in Blender of one of several equal objects of a scene, which has one look."""
    return f"{shape} copy {number}" if number else shape


def handles(bpy: Any, scene: Scene) -> list[Any]:
    """Blender's objects for those of a scene."""
    shapes = [item.shape for item in scene.objects]
    return [bpy.data.objects[copy_name(shape, shapes[:place].count(shape))] for place, shape in enumerate(shapes)]


def show_scene(bpy: Any, scene: Scene, meshes: Iterable[str] = (), brightness: float = 1.0) -> None:
    """Arrange everything on the stage as in a scene whose image will become brighter by a factor.

    `meshes` are the names of imported objects.
    """
    objects = bpy.data.objects
    objects["camera"].data.lens = scene.f * SENSOR_WIDTH / scene.S
    # p_scene = R^T (p_camera - translation), with Blender's axes in both frames
    back = rotation_matrix(scene.pose.rotation).T
    centre = product(-back, np.array(scene.pose.translation))
    objects["camera"].matrix_basis = matrix_of(product(back, TO_BLENDER), centre)
    for shape in (*SHAPES, *meshes):
        objects[shape].hide_render = True
    for item, handle in zip(scene.objects, handles(bpy, scene), strict=True):
        _place_object(bpy, item, handle)
    for name in get_args(LampName):
        objects[name].hide_render = name not in {lamp.name for lamp in scene.lamps}
    for lamp in scene.lamps:
        _place_lamp(objects[lamp.name], lamp, brightness)
    show_backdrop(bpy.data.worlds["world"].node_tree.nodes, scene.backdrop)


def shows_metal(bpy: Any, scene: Scene) -> list[bool]:
    """Of each object of a scene, whether the renderer makes it metal, because its mesh defines no material."""
    return [
        (item.look.metallic > 0 if item.look else item.material == "metal")
        and not any(bpy.data.objects[item.shape].data.materials)
        for item in scene.objects
    ]


def _place_object(bpy: Any, item: SceneObject, handle: Any) -> None:
    handle.hide_render = False
    size = 0.5 * np.array(item.dimensions) if item.shape in SHAPES else np.ones(3)
    stretch = item.scale * size
    handle.matrix_basis = matrix_of(rotation_matrix(item.rotation) * stretch, np.array(item.position))
    if item.look:
        show_look(bpy, item, item.look, handle)
        return
    if handle.data.materials[0] is not None:  # its own
        return
    handle.color = (*(linear(channel) for channel in item.colour), 1.0)
    handle.material_slots[0].link = "OBJECT"
    handle.material_slots[0].material = bpy.data.materials[item.material]


def build_stage(bpy: Any) -> None:
    """Empty Blender's file and fill it with one of each thing that a scene can contain."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    for material, surface in SURFACES.items():
        tree = bpy.data.materials.new(material).node_tree
        shader, info = tree.nodes["Principled BSDF"], tree.nodes.new("ShaderNodeObjectInfo")
        for key, value in surface.items():
            shader.inputs[key].default_value = value
        tree.links.new(info.outputs["Color"], shader.inputs["Base Color"])
    for shape in SHAPES:
        _add(bpy, shape, _new_mesh(bpy, shape))
    for name in get_args(LampName):
        light = bpy.data.lights.new(name, "AREA")
        light.shape = "SQUARE"
        _add(bpy, name, light).visible_camera = False  # a turned camera may face one
    camera = bpy.data.cameras.new("camera")
    camera.sensor_fit = "HORIZONTAL"
    camera.sensor_width = SENSOR_WIDTH
    camera.clip_start, camera.clip_end = CLIPPING
    bpy.context.scene.camera = _add(bpy, "camera", camera)
    world = bpy.context.scene.world = bpy.data.worlds.new("world")
    world.cycles.sampling_method = "NONE"  # an importance map is not worth it for such smooth light
    _paint_world(world.node_tree)


def _add(bpy: Any, name: str, data: Any) -> Any:
    handle = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(handle)
    return handle


def _new_mesh(bpy: Any, shape: Shape) -> Any:
    geometry = build_mesh(shape)
    mesh = bpy.data.meshes.new(shape)
    mesh.from_pydata(geometry.vertices, [], geometry.faces)
    mesh.polygons.foreach_set("use_smooth", geometry.smooth)
    mesh.materials.append(None)
    return mesh


def _place_lamp(handle: Any, lamp: Lamp, brightness: float) -> None:
    """An area lamp shines along its local -z."""
    position = np.array(lamp.position)
    forward = np.array(lamp.towards) - position
    handle.matrix_basis = matrix_of(product(TO_BLENDER, _aimed_along(product(TO_BLENDER, forward))), position)
    handle.data.energy = lamp.power / brightness
    handle.data.size = lamp.side


def matrix_of(linear: NDArray[np.float64], place: NDArray[np.float64]) -> list[list[float]]:
    """Blender's matrix, by columns, of the map p = linear local + place in our axes."""
    matrix = np.eye(4)
    matrix[:3, :3] = product(TO_BLENDER, linear)
    matrix[:3, 3] = product(TO_BLENDER, place)
    columns: list[list[float]] = matrix.T.tolist()
    return columns


def _aimed_along(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """A rotation (3, 3) whose -z axis is `direction`, with x level."""
    back = -unit(direction)
    right = unit(np.cross([0.0, 1.0, 0.0], back))
    return np.column_stack([right, np.cross(back, right), back])


def _paint_world(tree: Any) -> None:
    """Make a new world's node tree the backdrop for the camera, and the surroundings for all other rays.

    The backdrop is no surface: it receives no shadow and no light from the objects, which could reveal where they
    are, and it costs no samples.
    """
    tree.nodes.clear()
    output, shader, mix, rays = new_nodes(tree, "OutputWorld", "Background", "Mix", "LightPath")
    tree.links.new(rays.outputs["Is Camera Ray"], mix.inputs["Factor"])
    tree.links.new(_surroundings_nodes(tree), mix.inputs["A"])
    tree.links.new(_backdrop_nodes(tree), mix.inputs["B"])
    tree.links.new(mix.outputs["Result"], shader.inputs["Strength"])
    tree.links.new(shader.outputs["Background"], output.inputs["Surface"])
    shader.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)


def new_nodes(tree: Any, *kinds: str) -> Iterator[Any]:
    """Add a shader node of each kind to a node tree."""
    return (tree.nodes.new(f"ShaderNode{kind}") for kind in kinds)


def _backdrop_nodes(tree: Any) -> Any:
    """level + slope |window - centre|^2, with slope = -level falloff; `show_backdrop` finds the nodes by name."""
    window, offset, square, line = new_nodes(tree, "TexCoord", "VectorMath", "VectorMath", "Math")
    offset.name, line.name = "offset", "line"
    offset.operation, square.operation, line.operation = "SUBTRACT", "DOT_PRODUCT", "MULTIPLY_ADD"
    tree.links.new(window.outputs["Window"], offset.inputs[0])
    tree.links.new(offset.outputs["Vector"], square.inputs[0])
    tree.links.new(offset.outputs["Vector"], square.inputs[1])
    tree.links.new(square.outputs["Value"], line.inputs[0])
    return line.outputs["Value"]


def show_backdrop(nodes: Any, backdrop: Backdrop) -> None:
    """Set the inputs of a painted world's nodes to a backdrop."""
    x, y = backdrop.centre
    nodes["offset"].inputs[1].default_value = (x, 1 - y, 0.0)  # Blender counts from the bottom
    nodes["line"].inputs[1].default_value = -backdrop.level * backdrop.falloff
    nodes["line"].inputs[2].default_value = backdrop.level


def _surroundings_nodes(tree: Any) -> Any:
    """Brightness by the height of a direction, from straight below to straight above."""
    direction, split, ramp = new_nodes(tree, "TexCoord", "SeparateXYZ", "MapRange")
    ramp.inputs["From Min"].default_value, ramp.inputs["From Max"].default_value = -1.0, 1.0
    ramp.inputs["To Min"].default_value, ramp.inputs["To Max"].default_value = SURROUNDINGS
    tree.links.new(direction.outputs["Generated"], split.inputs["Vector"])
    tree.links.new(split.outputs["Y"], ramp.inputs["Value"])
    return ramp.outputs["Result"]

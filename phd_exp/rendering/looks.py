"""Random looks: surfaces of objects without materials, changes of tone of those with textures, and hard light.

A network that shall work on photographs must not rely on how a renderer draws plastic. With `data.looks=varied`,
objects without materials are grey, dark or coloured, matt or shiny, patterned or not; textures change their tone.
"""

import colorsys
import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from phd_exp.optics.virtual import unit
from phd_exp.records.scenes import PATTERNS, Lamp, Look, Scene, SceneObject, Vector
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.pixels import linear
from phd_exp.rendering.sampling import LAMP_DISTANCE, LAMPS, Stream, remoteness

HARD = 0.5  # share of the scenes with one small lamp, which casts hard shadows, in addition to the sky
ROUGHER = 0.28  # of metal in scenes with meshes: small convex parts have highlights of few pixels
NODES = {"noise": "ShaderNodeTexNoise", "checker": "ShaderNodeTexChecker", "scratches": "ShaderNodeTexWave"}
TONE = "phd_exp tone"
TONES = (0.02, 0.5, 0.4)  # largest change of a texture's hue (turns), and of its saturation and value (factors)


def varied(scene: Scene, spec: DatasetSpec, rng: Stream) -> Scene:
    """The scene with a look for each object and, under a sky, perhaps a lamp."""
    items = tuple(item.model_copy(update={"look": draw_look(rng), "colour": colour(rng)}) for item in scene.objects)
    lamps = scene.lamps or ((hard_lamp(spec, rng),) if rng.random() < HARD else ())
    return scene.model_copy(update={"objects": items, "lamps": lamps})


def draw_look(rng: Stream) -> Look:
    """A look of any object."""
    hue, saturation, value = TONES
    return Look(
        pattern=PATTERNS[rng.integers(len(PATTERNS))],
        cells=math.exp(rng.uniform(math.log(2), math.log(60))),
        second=colour(rng),
        roughness=float(rng.uniform(0.15, 0.95)),
        metallic=float(rng.random() < 0.25),
        hue=float(rng.uniform(-hue, hue)),
        saturation=float(rng.uniform(1 - saturation, 1 + saturation)),
        value=math.exp(rng.uniform(-value, value)),
    )


def colour(rng: Stream) -> tuple[float, float, float]:
    """sRGB: half of all are grey or pale, from nearly black to white."""
    saturation = rng.uniform(0, 0.15) if rng.random() < 0.5 else rng.uniform(0.15, 1)
    r, g, b = colorsys.hsv_to_rgb(rng.random(), saturation, rng.uniform(0.04, 1))
    return r, g, b


def hard_lamp(spec: DatasetSpec, rng: Stream) -> Lamp:
    """A lamp in a random direction, as bright as a sky."""
    direction, far = rng.normal(size=3), remoteness(spec)
    middle: Vector = (0.0, 0.0, sum(spec.z_range) / 2)
    x, y, z = (np.array(middle) + far * LAMP_DISTANCE * unit(direction)).tolist()
    name, _, _, power = LAMPS[0]
    side, power = rng.uniform(0.1, 3.0), power * rng.uniform(0.3, 2.0)
    return Lamp(name=name, position=(x, y, z), towards=middle, side=far * side, power=far**2 * power)


def prepare_looks(bpy: Any, names: Iterable[str]) -> None:
    """Build the materials of objects. None scatters light below its surface: Cycles then remembers earlier images."""
    for name in names:
        own = list(filter(None, bpy.data.objects[name].data.materials))
        for material in own:
            _add_tones(material.node_tree)
        for pattern in () if own else PATTERNS:
            _build_patterned(bpy, f"{pattern}-{name}", pattern)


def show_look(bpy: Any, item: SceneObject, look: Look, handle: Any) -> None:
    """Give an object of Blender's scene a look."""
    own = list(filter(None, handle.data.materials))
    for node in [node for material in own for node in material.node_tree.nodes if node.name.startswith(TONE)]:
        node.inputs["Hue"].default_value = 0.5 + look.hue
        node.inputs["Saturation"].default_value = look.saturation
        node.inputs["Value"].default_value = look.value
    if own:
        return
    material = bpy.data.materials[f"{look.pattern}-{item.shape}"]
    nodes = material.node_tree.nodes
    nodes["Principled BSDF"].inputs["Roughness"].default_value = max(look.roughness, ROUGHER * look.metallic)
    nodes["Principled BSDF"].inputs["Metallic"].default_value = look.metallic
    for place, rgb in ((0, item.colour), (1, look.second)):
        nodes["colours"].color_ramp.elements[place].color = (*(linear(channel) for channel in rgb), 1.0)
    if "pattern" in nodes:
        longest = max(item.dimensions) if item.shape.startswith("mesh") else 2.0  # solids fill a cube of side 2
        nodes["pattern"].inputs["Scale"].default_value = look.cells / longest
    handle.material_slots[0].link = "OBJECT"
    handle.material_slots[0].material = material


def _build_patterned(bpy: Any, name: str, pattern: str) -> None:
    """A material whose base colour is a ramp between two colours along a pattern in the object's own coordinates."""
    material = bpy.data.materials.new(name)
    tree = material.node_tree
    ramp = tree.nodes.new("ShaderNodeValToRGB")
    ramp.name = "colours"
    tree.links.new(ramp.outputs["Color"], tree.nodes["Principled BSDF"].inputs["Base Color"])
    if pattern == "plain":
        ramp.inputs["Fac"].default_value = 0.0
        return
    node, place = tree.nodes.new(NODES[pattern]), tree.nodes.new("ShaderNodeTexCoord")
    node.name = "pattern"
    tree.links.new(place.outputs["Object"], node.inputs["Vector"])
    if pattern == "scratches":
        node.inputs["Distortion"].default_value = 8.0
    tree.links.new(node.outputs["Fac"], ramp.inputs["Fac"])


def _add_tones(tree: Any) -> None:
    """Insert a node before each base colour of a material that changes its hue, saturation and value."""
    for shader in [node for node in tree.nodes if node.type == "BSDF_PRINCIPLED"]:
        node, base = tree.nodes.new("ShaderNodeHueSaturation"), shader.inputs["Base Color"]
        node.name = TONE
        node.inputs["Color"].default_value = base.default_value
        for link in list(base.links):
            tree.links.new(link.from_socket, node.inputs["Color"])
        tree.links.new(node.outputs["Color"], base)

"""Surfaces and surroundings as Blender's shader nodes: what things are made of, and what lies around them.

Handles of Blender's objects are given; nothing here imports it.
"""

from typing import Any

from phd_exp.records.scenes import Backdrop, Material

# Principled BSDF, by input. Rubber is matt with a faint sheen; metal is polished enough to mirror the lamps
# as soft boxes and its neighbours as blurs.
SURFACES: dict[Material, dict[str, float]] = {
    "rubber": {"Metallic": 0.0, "Roughness": 0.75, "Specular IOR Level": 0.25},
    "metal": {"Metallic": 1.0, "Roughness": 0.24},
}
# What objects, not the camera, see all around: dim below, brighter above, for metal to mirror.
SURROUNDINGS = (0.10, 0.75)


class BackdropInputs:
    """The three inputs of a painted world's nodes that change from sample to sample."""

    def __init__(self, tree: Any) -> None:
        nodes = tree.nodes
        self._centre = nodes["offset"].inputs[1]
        self._slope, self._level = nodes["line"].inputs[1], nodes["line"].inputs[2]

    def show(self, backdrop: Backdrop) -> None:
        """Let the camera see this backdrop."""
        x, y = backdrop.centre
        self._centre.default_value = (x, 1 - y, 0.0)  # Blender counts from the bottom
        self._slope.default_value = -backdrop.level * backdrop.falloff
        self._level.default_value = backdrop.level


def paint_surface(tree: Any, material: Material) -> None:
    """Make a new material's node tree a surface whose colour is that of the object it is on."""
    shader = tree.nodes["Principled BSDF"]
    for key, value in SURFACES[material].items():
        shader.inputs[key].default_value = value
    info = tree.nodes.new("ShaderNodeObjectInfo")
    tree.links.new(info.outputs["Color"], shader.inputs["Base Color"])


def paint_world(tree: Any) -> None:
    """Make a new world's node tree two worlds in one: the camera sees the backdrop, all else the surroundings.

    A backdrop that is no surface takes no shadow and no light from the objects, so that nothing in it tells where
    they are, and it costs no samples.
    """
    tree.nodes.clear()
    output = tree.nodes.new("ShaderNodeOutputWorld")
    shader = tree.nodes.new("ShaderNodeBackground")
    mix = tree.nodes.new("ShaderNodeMix")
    rays = tree.nodes.new("ShaderNodeLightPath")
    tree.links.new(rays.outputs["Is Camera Ray"], mix.inputs["Factor"])
    tree.links.new(_surroundings_nodes(tree), mix.inputs["A"])
    tree.links.new(_backdrop_nodes(tree), mix.inputs["B"])
    tree.links.new(mix.outputs["Result"], shader.inputs["Strength"])
    tree.links.new(shader.outputs["Background"], output.inputs["Surface"])
    shader.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)


def _backdrop_nodes(tree: Any) -> Any:
    """level + slope |window - centre|^2, with slope = -level falloff; named, for `BackdropInputs` to find."""
    window = tree.nodes.new("ShaderNodeTexCoord")
    offset = tree.nodes.new("ShaderNodeVectorMath")
    square = tree.nodes.new("ShaderNodeVectorMath")
    line = tree.nodes.new("ShaderNodeMath")
    offset.name, line.name = "offset", "line"
    offset.operation, square.operation, line.operation = "SUBTRACT", "DOT_PRODUCT", "MULTIPLY_ADD"
    tree.links.new(window.outputs["Window"], offset.inputs[0])
    tree.links.new(offset.outputs["Vector"], square.inputs[0])
    tree.links.new(offset.outputs["Vector"], square.inputs[1])
    tree.links.new(square.outputs["Value"], line.inputs[0])
    return line.outputs["Value"]


def _surroundings_nodes(tree: Any) -> Any:
    """Brightness by the height of a direction, from straight below to straight above."""
    direction = tree.nodes.new("ShaderNodeTexCoord")
    split = tree.nodes.new("ShaderNodeSeparateXYZ")
    ramp = tree.nodes.new("ShaderNodeMapRange")
    ramp.inputs["From Min"].default_value, ramp.inputs["From Max"].default_value = -1.0, 1.0
    ramp.inputs["To Min"].default_value, ramp.inputs["To Max"].default_value = SURROUNDINGS
    tree.links.new(direction.outputs["Generated"], split.inputs["Vector"])
    tree.links.new(split.outputs["Y"], ramp.inputs["Value"])
    return ramp.outputs["Result"]

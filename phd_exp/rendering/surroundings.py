"""What is around an object: a sky that lights it, a photograph behind it, the ground below it, and a shaken camera.

`World` receives Blender's module; this file does not import it.
"""

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageOps
from scipy import ndimage

from phd_exp.records.assets import Asset
from phd_exp.records.images import FORMATS, content_of, decoding, pillow_warnings
from phd_exp.records.scenes import Pose, Surroundings
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.pixels import Light, linear
from phd_exp.rendering.rays import rotation_matrix
from phd_exp.rendering.sampling import about_axis, remoteness
from phd_exp.rendering.stage import TO_BLENDER, matrix_of, new_nodes

GROUND = 1000.0  # m: side of the plane
IMPORTANCE_MAP = 512  # px: that of a sky's own resolution, 1024, would take a second for each image
_LINEAR = np.array([linear(value / 255) for value in range(256)])
"""Linear light of 8-bit values."""


class World:
    """Blender's sky and ground, built once and then arranged for one scene after another."""

    def __init__(self, bpy: Any, spec: DatasetSpec) -> None:
        self._bpy, self._spec = bpy, spec
        self._sky, self._studio = bpy.data.worlds.new("sky"), bpy.context.scene.world
        self._sky.cycles.sampling_method, self._sky.cycles.sample_map_resolution = "MANUAL", IMPORTANCE_MAP
        _paint_sky(self._sky.node_tree)
        bpy.ops.mesh.primitive_plane_add(size=remoteness(spec) * GROUND)
        self._ground = bpy.context.object
        self._ground.is_shadow_catcher = True

    def show(self, around: Surroundings, pose: Pose) -> None:
        """Arrange the sky and the ground for a camera. Without a sky, the background is transparent."""
        scene = self._bpy.context.scene
        scene.render.film_transparent = not around.is_sky
        scene.world = self._sky if around.is_sky else self._studio
        if around.is_sky and around.file:
            self._show_sky(around, around.file, pose)
        self._ground.hide_render = around.ground is None
        if around.ground is not None:
            level = rotation_matrix(about_axis((1.0, 0.0, 0.0), math.pi / 2 + around.pitch))
            self._ground.matrix_world = matrix_of(level, np.array(around.ground))

    def _show_sky(self, around: Surroundings, file: str, pose: Pose) -> None:
        nodes, images = self._sky.node_tree.nodes, self._bpy.data.images
        folder = Path(self._bpy.utils.system_resource("DATAFILES", path="studiolights/world"))
        backdrops = self._spec.backdrops
        path = backdrops.path(file) if isinstance(backdrops, Asset) else folder / f"{file}.exr"
        before, image = nodes["panorama"].image, images.load(str(path), check_existing=True)
        nodes["panorama"].image = image
        if before not in (None, image):
            images.remove(before)
        nodes["light"].inputs["Strength"].default_value = around.brightness
        # a panorama's vertical is z, the level camera's is Blender's y
        nodes["turn"].inputs["Rotation"].default_value = (math.pi / 2 - around.pitch, 0.0, around.turn)
        axis = TO_BLENDER @ rotation_matrix(pose.rotation)[2]  # of the camera
        nodes["along"].inputs[1].default_value = axis
        nodes["span"].inputs[1].default_value = (1 / around.span - 1) * axis


def _paint_sky(tree: Any) -> None:
    """Light from a panorama; `_show_sky` finds the nodes by name.

    For rays of the camera, the part of a direction along the camera's axis is first divided by the span.
    """
    tree.nodes.clear()
    directions, turn, panorama, light, output = new_nodes(
        tree, "TexCoord", "Mapping", "TexEnvironment", "Background", "OutputWorld"
    )
    rays, along, if_camera, span = new_nodes(tree, "LightPath", "VectorMath", "Math", "VectorMath")
    turn.name, panorama.name, light.name = "turn", "panorama", "light"
    along.name, span.name = "along", "span"
    along.operation, if_camera.operation, span.operation = "DOT_PRODUCT", "MULTIPLY", "MULTIPLY_ADD"
    tree.links.new(directions.outputs["Generated"], along.inputs[0])
    tree.links.new(along.outputs["Value"], if_camera.inputs[0])
    tree.links.new(rays.outputs["Is Camera Ray"], if_camera.inputs[1])
    tree.links.new(if_camera.outputs["Value"], span.inputs[0])
    tree.links.new(directions.outputs["Generated"], span.inputs[2])
    tree.links.new(span.outputs["Vector"], turn.inputs["Vector"])
    tree.links.new(turn.outputs["Vector"], panorama.inputs["Vector"])
    tree.links.new(panorama.outputs["Color"], light.inputs["Color"])
    tree.links.new(light.outputs["Background"], output.inputs["Surface"])


def photo_light(path: Path, around: Surroundings, S: int) -> Light:
    """A square of a photograph as linear light (S, S, 3). Raises DatasetError if the file is no image."""
    with decoding(path), pillow_warnings(), Image.open(io.BytesIO(content_of(path)), formats=FORMATS) as image:
        upright = ImageOps.exif_transpose(image).convert("RGB")
    side = around.square[2] * min(upright.size)
    left, top = (share * (size - side) for share, size in zip(around.square, upright.size, strict=False))
    square = upright.resize((S, S), Image.Resampling.LANCZOS, box=(left, top, left + side, top + side))
    light = _LINEAR[np.asarray(square)]
    return light[:, ::-1] if around.flipped else light


def shaken(light: Light, path: tuple[float, float]) -> Light:
    """The mean of an image (S, S, 3) along a straight path right and down, px, around its place."""
    if not (length := math.hypot(*path)):
        return light
    n = math.ceil(length) + 1
    shifts = [(share * path[1], share * path[0], 0.0) for share in (np.arange(n) + 0.5) / n - 0.5]
    return np.mean([ndimage.shift(light, shift, order=1, mode="nearest") for shift in shifts], axis=0)

"""What is around an object: a sky that lights it, a photograph behind it, the ground below it, and a shaken camera.

Functions receive Blender's module; this file does not import it.
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
from phd_exp.records.scenes import Photo, Scene, Sky
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.pixels import Light, linear
from phd_exp.rendering.rays import rotation_matrix
from phd_exp.rendering.sampling import about_axis
from phd_exp.rendering.stage import TO_BLENDER, matrix_of

GROUND = 1000.0  # m: side of the plane
IMPORTANCE_MAP = 512  # px: a sky's own resolution of 1024 would take a second for each image
SKY_WORLD, STUDIO_WORLD = "sky", "world"


class World:
    """Blender's sky and ground, built once and then arranged for one scene after another."""

    def __init__(self, bpy: Any, spec: DatasetSpec) -> None:
        self._bpy, self._spec = bpy, spec
        self._means: dict[Path, float] = {}
        world = bpy.data.worlds.new(SKY_WORLD)
        world.cycles.sampling_method, world.cycles.sample_map_resolution = "MANUAL", IMPORTANCE_MAP
        _paint_sky(world.node_tree)
        plane = bpy.data.meshes.new("ground")
        corners = [(x * GROUND / 2, y * GROUND / 2, 0.0) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        plane.from_pydata(corners, [], [(0, 1, 2, 3)])
        self._ground = bpy.data.objects.new("ground", plane)
        self._ground.is_shadow_catcher = True
        bpy.context.scene.collection.objects.link(self._ground)

    def show(self, scene: Scene) -> None:
        """Arrange the sky and the ground of a scene. Without a sky, the background is transparent."""
        around = scene.surroundings
        assert around is not None
        blender = self._bpy.context.scene
        blender.render.film_transparent = not isinstance(around.background, Sky)
        blender.world = self._bpy.data.worlds[STUDIO_WORLD if blender.render.film_transparent else SKY_WORLD]
        if isinstance(around.background, Sky):
            self._show_sky(around.background, around.pitch)
        self._ground.hide_render = around.ground is None
        if around.ground is not None:
            level = rotation_matrix(about_axis((1.0, 0.0, 0.0), math.pi / 2 + around.pitch))
            self._ground.matrix_world = matrix_of(level, np.array(around.ground))

    def _show_sky(self, sky: Sky, pitch: float) -> None:
        nodes = self._bpy.data.worlds[SKY_WORLD].node_tree.nodes
        path = self._path(sky.file)
        before, nodes["panorama"].image = (
            nodes["panorama"].image,
            self._bpy.data.images.load(str(path), check_existing=True),
        )
        if before not in (None, nodes["panorama"].image):
            self._bpy.data.images.remove(before)
        if path not in self._means:
            self._means[path] = mean_radiance(nodes["panorama"].image)
        nodes["light"].inputs["Strength"].default_value = sky.brightness / self._means[path]
        # a panorama's vertical is z, the level camera's is Blender's y
        nodes["turn"].inputs["Rotation"].default_value = (math.pi / 2 - pitch, 0.0, sky.turn)

    def _path(self, file: str) -> Path:
        if isinstance(self._spec.backdrops, Asset):
            return self._spec.backdrops.path(file)
        folder = self._bpy.utils.system_resource("DATAFILES", path="studiolights/world")
        return Path(folder) / f"{file}.exr"


def _paint_sky(tree: Any) -> None:
    tree.nodes.clear()
    kinds = {"TexCoord": "directions", "Mapping": "turn", "TexEnvironment": "panorama", "Background": "light"}
    directions, turn, panorama, light = (tree.nodes.new(f"ShaderNode{kind}") for kind in kinds)
    for node, name in zip((directions, turn, panorama, light), kinds.values(), strict=True):
        node.name = name
    tree.links.new(directions.outputs["Generated"], turn.inputs["Vector"])
    tree.links.new(turn.outputs["Vector"], panorama.inputs["Vector"])
    tree.links.new(panorama.outputs["Color"], light.inputs["Color"])
    tree.links.new(light.outputs["Background"], tree.nodes.new("ShaderNodeOutputWorld").inputs["Surface"])


def mean_radiance(panorama: Any) -> float:
    """Mean of a panorama over all directions: rows near its poles are small."""
    width, height = panorama.size
    pixels = np.empty(width * height * 4, np.float32)
    panorama.pixels.foreach_get(pixels)
    rows = pixels.reshape(height, width, 4)[..., :3].mean(axis=(1, 2), dtype=np.float64)
    return float(np.average(rows, weights=np.sin(math.pi * (np.arange(height) + 0.5) / height)))


def photo_light(photo: Photo, path: Path, S: int) -> Light:
    """The square of a photograph as linear light (S, S, 3). Raises DatasetError if the file is no image."""
    with decoding(path), pillow_warnings(), Image.open(io.BytesIO(content_of(path)), formats=FORMATS) as image:
        upright = ImageOps.exif_transpose(image).convert("RGB")
    side = photo.side * min(upright.size)
    left, top = (share * (size - side) for share, size in zip(photo.place, upright.size, strict=True))
    square = upright.resize((S, S), Image.Resampling.LANCZOS, box=(left, top, left + side, top + side))
    light = _LINEAR[np.asarray(square)]
    return light[:, ::-1] if photo.flipped else light


_LINEAR = np.array([linear(value / 255) for value in range(256)])
"""Linear light of 8-bit values."""


def shaken(light: Light, path: tuple[float, float]) -> Light:
    """The mean of an image (S, S, 3) along a straight path right and down, px, around its place."""
    length = math.hypot(*path)
    if not length:
        return light
    places = np.linspace(-0.5, 0.5, math.ceil(length) + 1)
    shifts = [(share * path[1], share * path[0], 0.0) for share in places]
    return np.mean([ndimage.shift(light, shift, order=1, mode="nearest") for shift in shifts], axis=0)

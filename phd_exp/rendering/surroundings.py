"""What is around an object: a sky that lights it, a photograph behind it, the ground below it, and a shaken camera.

`World` receives Blender's module; this file does not import it.
"""

import io
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps
from scipy import ndimage
from scipy.spatial.transform import Rotation

from phd_exp.optics.virtual import product
from phd_exp.records.assets import Asset
from phd_exp.records.images import FORMATS, content_of, decoding, pillow_warnings
from phd_exp.records.scenes import Scene, Surroundings
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.antialias import filtered
from phd_exp.rendering.pixels import Light, linear
from phd_exp.rendering.rays import rotation_matrix
from phd_exp.rendering.sampling import about_axis, remoteness
from phd_exp.rendering.stage import TO_BLENDER, handles, matrix_of, new_nodes

GROUND = 1000.0  # m: side of the plane
IMPORTANCE_MAP = 512  # px: that of a sky's own resolution, 1024, would take a second for each image
FINEST = 8  # largest number of points, along each side of a pixel, at which the sky is looked up
_LINEAR = np.array([linear(value / 255) for value in range(256)])
"""Linear light of 8-bit values."""


class World:
    """Blender's sky and ground, built once and then arranged for one scene after another.

    Cycles needs longer for a new sky than for a new scene. Therefore the sky stays while its file is the same: it is
    the scene, a child of the object `frame`, that turns, and it is the image that becomes brighter.
    """

    def __init__(self, bpy: Any, spec: DatasetSpec) -> None:
        self._bpy, self._spec = bpy, spec
        self._sky, self._studio = bpy.data.worlds.new("sky"), bpy.context.scene.world
        self._sky.cycles.sampling_method, self._sky.cycles.sample_map_resolution = "MANUAL", IMPORTANCE_MAP
        self._shown = _paint_sky(self._sky.node_tree)
        self._panorama: tuple[str, NDArray[np.float32]] | None = None
        bpy.ops.mesh.primitive_plane_add(size=remoteness(spec) * GROUND)
        self._ground = bpy.context.object
        self._ground.is_shadow_catcher = True
        self._glowing = list(_glowing(bpy))
        self._frame = bpy.data.objects.new("frame", None)
        for item in bpy.context.scene.objects:
            item.parent = self._frame
        bpy.context.scene.collection.objects.link(self._frame)

    def show(self, around: Surroundings) -> float:
        """Arrange the sky and the ground for a scene; returns the factor by which its image is to be brighter."""
        self._bpy.context.scene.world = self._sky if around.is_sky else self._studio
        self._frame.matrix_basis = np.eye(4).tolist()
        if around.is_sky and around.file:
            self._load(around.file)
            self._frame.matrix_basis = matrix_of(product(TO_BLENDER, to_sky(around)), np.zeros(3))
        self._ground.hide_render = around.ground is None
        if around.ground is not None:
            level = rotation_matrix(about_axis((1.0, 0.0, 0.0), math.pi / 2 + around.pitch))
            self._ground.matrix_basis = matrix_of(level, np.array(around.ground))
        brightness = around.brightness if around.is_sky else 1.0
        for strength, value in self._glowing:
            strength.default_value = value / brightness
        return brightness

    def show_layer(self, scene: Scene, layer: str) -> None:
        """Let the camera show either the objects or the ground; each lights and shades the other."""
        for handle in handles(self._bpy, scene):
            handle.visible_camera = layer == "objects"
        self._ground.visible_camera = layer == "ground"

    def behind(self, scene: Scene) -> Light:
        """The sky (S, S, 3) that the camera of a scene shows behind all objects, linear light."""
        around = scene.surroundings
        assert around is not None
        assert around.file is not None
        turn = product(product(to_sky(around), TO_BLENDER), rotation_matrix(scene.pose.rotation).T)
        return around.brightness * sky_light(self._load(around.file), turn, scene.f / around.span, scene.S)

    def _load(self, file: str) -> NDArray[np.float32]:
        """Make a file the sky; returns its light (height, width, 3), rows from the bottom."""
        if self._panorama and self._panorama[0] == file:
            return self._panorama[1]
        folder = Path(self._bpy.utils.system_resource("DATAFILES", path="studiolights/world"))
        backdrops = self._spec.backdrops
        path = backdrops.path(file) if isinstance(backdrops, Asset) else folder / f"{file}.exr"
        before, image = self._shown.image, self._bpy.data.images.load(str(path), check_existing=True)
        self._shown.image = image
        if before not in (None, image):
            self._bpy.data.images.remove(before)
        width, height = image.size
        light = np.empty(width * height * image.channels, np.float32)
        image.pixels.foreach_get(light)
        self._panorama = (file, light.reshape(height, width, -1)[..., :3].copy())
        return self._panorama[1]


def _paint_sky(tree: Any) -> Any:
    """Light from a panorama, whose node is returned."""
    tree.nodes.clear()
    panorama, light, output = new_nodes(tree, "TexEnvironment", "Background", "OutputWorld")
    tree.links.new(panorama.outputs["Color"], light.inputs["Color"])
    tree.links.new(light.outputs["Background"], output.inputs["Surface"])
    return panorama


def _glowing(bpy: Any) -> Iterator[tuple[Any, float]]:
    """Inputs for the strength of the light that materials emit, and their values."""
    for material in bpy.data.materials:
        for node in material.node_tree.nodes:
            name = {"BSDF_PRINCIPLED": "Emission Strength", "EMISSION": "Strength"}.get(node.type)
            if name and node.inputs[name].default_value:
                yield node.inputs[name], node.inputs[name].default_value


def to_sky(around: Surroundings) -> Light:
    """Rotation (3, 3) from Blender's axes of a scene, where y is up for a level camera, to its sky's, where z is."""
    return Rotation.from_euler("xz", [math.pi / 2 - around.pitch, around.turn]).as_matrix()


def sky_light(panorama: NDArray[np.float32], turn: Light, f: float, S: int) -> Light:
    """A sky as a camera shows it (S, S, 3), linear light, under Blender's pixel filter.

    Args:
        panorama: light (height, width, 3) of all directions; rows from straight below to straight above, the middle
            column shows the direction x, and those to its right turn towards -y.
        turn: rotation (3, 3) from the camera's frame to the panorama's, whose z points up.
    """
    from phd_exp.rendering.rasterizing import look_up

    texels = panorama.shape[1] / (2 * math.pi * f)  # that a pixel spans
    finer = min(max(1, math.ceil(2 * texels)), FINEST)
    side = (np.arange(finer * (S + 2)) + 0.5) / finer - 1 - S / 2  # one pixel more at each border, for the filter
    return filtered(look_up(panorama, turn.astype(np.float32), (side / f).astype(np.float32)), finer)


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

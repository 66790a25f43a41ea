"""Scenes to pixels with Cycles: the one file that knows Blender.

Blender's camera looks along -z with y up, ours along z with y down: p_blender = diag(1, -1, -1) p.
"""

import importlib
import importlib.metadata
import importlib.util
import os
import sys
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from phd_exp.records.scenes import Lamp, LampName, Material, Scene, SceneObject, Shape
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering import shaders
from phd_exp.rendering.errors import RenderError
from phd_exp.rendering.meshes import build_mesh
from phd_exp.rendering.visibility import rotation_matrix

Pixels = NDArray[np.uint8]

X_LIBRARIES = "libx11-6 libxext6 libxfixes3 libxi6 libxrender1 libxkbcommon0 libsm6 libice6 libgl1"
TO_BLENDER = np.diag([1.0, -1.0, -1.0])
SENSOR_WIDTH = 36.0  # mm; any value does, the focal length is given in the same unit
SHAPES: tuple[Shape, ...] = get_args(Shape)
MATERIALS: tuple[Material, ...] = get_args(Material)
LAMP_NAMES: tuple[LampName, ...] = get_args(LampName)


def require_bpy() -> None:
    """Check, without loading it, that Blender's Python module is installed.

    Raises:
        RenderError: it is not.
    """
    if importlib.util.find_spec("bpy") is None:
        raise RenderError(
            "rendering needs bpy, Blender as a Python module, which is not installed: "
            "pip install 'phd_exp[render]' "
            f"(Python 3.11; this is {sys.version_info.major}.{sys.version_info.minor})"
        )


def renderer_version() -> str:
    """Name and version of the path tracer, without loading it."""
    try:
        return f"bpy {importlib.metadata.version('bpy')}"
    except importlib.metadata.PackageNotFoundError:  # built from source
        return "bpy of unknown version"


def load_bpy() -> Any:
    """Blender's Python module, a second or so the first time.

    Raises:
        RenderError: it, or a library of the system that it needs, is not installed.
    """
    require_bpy()
    try:
        return importlib.import_module("bpy")
    except ImportError as error:
        raise RenderError(
            f"bpy is installed but cannot be loaded ({error}): apt-get install {X_LIBRARIES}"
        ) from error


class Box(NamedTuple):
    """Pixels left <= column < right and top <= row < bottom."""

    left: int
    top: int
    right: int
    bottom: int


class Renderer:
    """Renders scenes of one specification; builds Blender's scene once and then only moves what differs.

    Blender keeps its state per process, so a second renderer in the same process takes the scene over.

    Raises:
        RenderError: bpy or a library it needs is missing.
    """

    def __init__(self, spec: DatasetSpec) -> None:
        self._bpy = load_bpy()
        self._spec = spec
        self._output = _fast_folder() / f"phd_exp-{uuid.uuid4().hex}.bmp"
        with _silence():
            self._build()

    def render(self, scene: Scene, box: Box | None = None) -> Pixels:
        """Image of a box of pixels (height, width, 3), or of all (S, S, 3): sRGB, rows from the top.

        A pure function of the scene, the box and the specification.
        """
        self._frame(box or Box(0, 0, scene.S, scene.S), scene.S)
        self._place_camera(scene)
        shown = {item.shape: item for item in scene.objects}
        for shape, handle in self._objects.items():
            handle.hide_render = shape not in shown
            if shape in shown:
                self._place_object(handle, shown[shape])
        for lamp in scene.lamps:
            self._place_lamp(self._lamps[lamp.name], lamp)
        self._backdrop.show(scene.backdrop)
        self._scene.cycles.seed = scene.noise_seed
        return self._shoot()

    def _shoot(self) -> Pixels:
        # In background mode Blender hands pixels out through files only; an uncompressed one costs 2 to 4 ms.
        self._scene.render.filepath = str(self._output)
        try:
            with _silence():
                self._bpy.ops.render.render(write_still=True)
            with Image.open(self._output) as image:
                return np.array(image.convert("RGB"))
        finally:
            self._output.unlink(missing_ok=True)

    # Once per process.

    def _build(self) -> None:
        self._bpy.ops.wm.read_factory_settings(use_empty=True)
        self._scene = self._bpy.context.scene
        self._materials = {name: self._bpy.data.materials.new(name) for name in MATERIALS}
        for name, material in self._materials.items():
            shaders.paint_surface(material.node_tree, name)
        self._objects = {shape: self._new_object(shape) for shape in SHAPES}
        self._lamps = {name: self._new_lamp(name) for name in LAMP_NAMES}
        self._camera = self._new_camera()
        self._scene.world = self._bpy.data.worlds.new("world")
        self._scene.world.cycles.sampling_method = "NONE"  # too smooth for a map of its light to be worth it
        self._backdrop = shaders.paint_world(self._scene.world.node_tree)
        self._configure()

    def _configure(self) -> None:
        """Every setting that differs from Blender's factory settings, with its reason."""
        render, cycles = self._scene.render, self._scene.cycles
        render.engine = "CYCLES"
        render.threads_mode = "FIXED"
        render.threads = 1  # processes share the cores without loss, threads do not
        render.use_persistent_data = True  # meshes and shaders stay loaded between samples
        render.resolution_x = render.resolution_y = self._spec.sensor_size
        render.resolution_percentage = 100
        render.use_border = render.use_crop_to_border = True
        render.use_file_extension = False
        render.image_settings.file_format = "BMP"
        render.image_settings.color_mode = "RGB"
        render.dither_intensity = 0.0
        self._scene.display_settings.display_device = "sRGB"
        self._scene.view_settings.view_transform = "Standard"  # plain sRGB: colours stay what the records say
        cycles.device = "CPU"
        cycles.samples = self._spec.samples_per_pixel
        cycles.use_adaptive_sampling = False  # would spend a variable number of samples; there are few anyway
        cycles.use_light_tree = True  # +4 dB
        cycles.max_bounces = 2  # objects colour each other once; more changes nothing one can measure
        cycles.diffuse_bounces = cycles.glossy_bounces = 2
        cycles.transmission_bounces = cycles.volume_bounces = cycles.transparent_max_bounces = 0
        cycles.use_denoising = True
        cycles.denoiser = "OPENIMAGEDENOISE"
        cycles.denoising_quality = "FAST"  # HIGH takes a quarter longer for half a dB
        cycles.denoising_input_passes = "RGB"  # albedo and normals made FAST worse
        cycles.denoising_prefilter = "NONE"

    def _new_object(self, shape: Shape) -> Any:
        geometry = build_mesh(shape)
        mesh = self._bpy.data.meshes.new(shape)
        mesh.from_pydata(geometry.vertices, [], geometry.faces)
        mesh.polygons.foreach_set("use_smooth", geometry.smooth)
        mesh.materials.append(None)
        return self._link(self._bpy.data.objects.new(shape, mesh))

    def _new_lamp(self, name: str) -> Any:
        light = self._bpy.data.lights.new(name, "AREA")
        light.shape = "SQUARE"
        return self._link(self._bpy.data.objects.new(name, light))

    def _new_camera(self) -> Any:
        camera = self._bpy.data.cameras.new("camera")
        camera.sensor_fit = "HORIZONTAL"
        camera.sensor_width = SENSOR_WIDTH
        camera.clip_start, camera.clip_end = 0.01, 1000.0
        self._scene.camera = self._link(self._bpy.data.objects.new("camera", camera))
        return camera

    def _link(self, item: Any) -> Any:
        self._scene.collection.objects.link(item)
        return item

    # Once per sample.

    def _frame(self, box: Box, side: int) -> None:
        """Blender wants shares of the image from the bottom left corner, and cuts them off to whole pixels.

        Half a pixel more, and rounding cannot lose one.
        """
        render = self._scene.render
        render.border_min_x, render.border_max_x = (box.left + 0.5) / side, (box.right + 0.5) / side
        render.border_min_y = (side - box.bottom + 0.5) / side
        render.border_max_y = (side - box.top + 0.5) / side

    def _place_camera(self, scene: Scene) -> None:
        self._camera.lens = scene.f * SENSOR_WIDTH / scene.S

    def _place_object(self, handle: Any, item: SceneObject) -> None:
        matrix = np.eye(4)
        stretch = 0.5 * item.scale * np.array(item.dimensions)
        matrix[:3, :3] = TO_BLENDER @ rotation_matrix(item.rotation) * stretch
        matrix[:3, 3] = TO_BLENDER @ np.array(item.position)
        handle.matrix_world = matrix.T.tolist()
        handle.color = (*(_linear(channel) for channel in item.colour), 1.0)
        handle.material_slots[0].link = "OBJECT"
        handle.material_slots[0].material = self._materials[item.material]

    def _place_lamp(self, handle: Any, lamp: Lamp) -> None:
        """An area lamp shines along its own -z."""
        position = TO_BLENDER @ np.array(lamp.position)
        middle = TO_BLENDER @ np.array([0.0, 0.0, sum(self._spec.z_range) / 2])
        matrix = np.eye(4)
        matrix[:3, :3] = _facing(middle - position)
        matrix[:3, 3] = position
        handle.matrix_world = matrix.T.tolist()
        handle.data.energy = lamp.power
        handle.data.size = lamp.side


def _facing(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """A rotation (3, 3) whose -z axis is `direction`, with x level."""
    back = -direction / np.linalg.norm(direction)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(back, right), back])


def _linear(channel: float) -> float:
    """sRGB to linear light (IEC 61966-2-1)."""
    return channel / 12.92 if channel <= 0.04045 else ((channel + 0.055) / 1.055) ** 2.4


def _fast_folder() -> Path:
    """A folder in memory where the system has one."""
    memory = Path("/dev/shm")
    return memory if os.access(memory, os.W_OK) else Path(tempfile.gettempdir())


@contextmanager
def _silence() -> Iterator[None]:
    """Send nowhere what Blender's C code prints, past Python, to the standard output and error."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = {stream: os.dup(stream) for stream in (1, 2)}
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        for stream in kept:
            os.dup2(nowhere, stream)
        yield
    finally:
        for stream, original in kept.items():
            os.dup2(original, stream)
            os.close(original)
        os.close(nowhere)

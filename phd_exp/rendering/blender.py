"""From scenes to pixels with Cycles; the only file that imports Blender."""

import importlib
import importlib.metadata
import importlib.util
import os
import sys
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from phd_exp.records.errors import RenderError
from phd_exp.records.scenes import SHAPES, Scene
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.antialias import filtered
from phd_exp.rendering.importing import import_meshes
from phd_exp.rendering.looks import ROUGHER, prepare_looks
from phd_exp.rendering.pixels import Box, Light, read_light
from phd_exp.rendering.sampling import remoteness
from phd_exp.rendering.stage import CLIPPING, build_stage, copy_name, show_scene, shows_metal
from phd_exp.rendering.surroundings import World
from phd_exp.rendering.triangles import Meshes

Layer = Literal["objects", "ground"]
X_LIBRARIES = "libx11-6 libxext6 libxfixes3 libxi6 libxrender1 libxkbcommon0 libsm6 libice6 libgl1"


def require_bpy() -> None:
    """Raise RenderError unless Blender's Python module is installed; does not load it."""
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
    """Blender's Python module, which takes about a second to load.

    Raises RenderError if the module, or a system library that it needs, is not installed.
    """
    require_bpy()
    try:
        return importlib.import_module("bpy")
    except ImportError as error:
        raise RenderError(
            f"bpy is installed but cannot be loaded ({error}): apt-get install {X_LIBRARIES}"
        ) from error


@dataclass(frozen=True)
class Settings:
    """Settings of the path tracer.

    Attributes:
        samples: light paths from each point of a pixel, or from all of a pixel without points.
        denoised: use Open Image Denoise.
        points: points along a side of each pixel at which the light is computed; a pixel is the mean of several over
            Blender's filter. None: Blender draws the points at random.
    """

    samples: int
    denoised: bool
    points: int | None


class Renderer:
    """Renders scenes; builds Blender's scene once and then changes only the differences.

    Blender has one state per process: a second renderer in the same process replaces the first one's scene.

    `meshes` are those of the specification. Raises RenderError if bpy or a library it needs is missing, or a mesh
    cannot be used.
    """

    def __init__(self, settings: Settings, spec: DatasetSpec | None = None) -> None:
        memory = Path("/dev/shm")  # a folder in memory, where the system has one
        place = memory if os.access(memory, os.W_OK) else Path(tempfile.gettempdir())
        self._output = place / f"phd_exp-{uuid.uuid4().hex}.exr"
        self._settings = settings
        with silence():
            self._bpy = load_bpy()
            build_stage(self._bpy)
            self._scene = self._bpy.context.scene
            _configure_image(self._scene)
            _configure_tracer(self._scene.cycles, settings)
            self.meshes: Meshes = import_meshes(self._bpy, spec) if spec else {}
            copies = [copy_name("mesh", number + 1) for number in range(spec.copies if spec else 0)]
            self._imported = [*self.meshes, *copies]
            self._world = World(self._bpy, spec) if spec and spec.mesh else None
            if self.meshes:
                _configure_for_meshes(self._bpy)
            self.is_opaque = all(mesh.is_opaque for mesh in self.meshes.values())
            if spec and spec.looks == "varied":
                prepare_looks(self._bpy, [*SHAPES, *self.meshes])
            if spec:  # what is nearer or farther than usual is shown too
                lens, (near, far) = self._scene.camera.data, CLIPPING
                lens.clip_start, lens.clip_end = near * min(1, 2 * spec.z_range[0]), far * remoteness(spec)

    def render(
        self, scene: Scene, box: Box | None = None, layer: Layer = "objects", points: int | None = None
    ) -> Light:
        """Linear light of a box of pixels (height, width, 3), by default of all (S, S, 3); rows from the top.

        An image is white from 1 upwards. A pure function of the arguments and the settings. With meshes, the
        background is transparent: a fourth channel is the opacity, by which the light is multiplied. The layer
        "ground" shows the ground without the objects; its opacity is their shadow. `points` replaces the points of
        the settings, not the number of samples at each.
        """
        box, points = box or Box(0, 0, scene.S, scene.S), points or self._settings.points
        self._set_filter(points)
        if (finer := points or 1) == 1:
            return self._traced(scene, box, layer)
        # a pixel more on each side, because the filter reaches that far
        wider = scene.model_copy(update={"S": finer * (scene.S + 2), "f": finer * scene.f})
        around = Box(finer * box.left, finer * box.top, finer * (box.right + 2), finer * (box.bottom + 2))
        return filtered(self._traced(wider, around, layer), finer)

    def _traced(self, scene: Scene, box: Box, layer: Layer) -> Light:
        """The light that the tracer computes for a box of the pixels of a scene."""
        self._frame(box, scene.S)
        brightness = self._world.show(scene.surroundings) if self._world and scene.surroundings else 1.0
        show_scene(self._bpy, scene, self._imported, brightness)
        if self._world:
            self._world.show_layer(scene, layer)
            # chooses among lamps, and takes a fifth of the time
            self._scene.cycles.use_light_tree = bool(scene.lamps)
        self._scene.cycles.seed = scene.noise_seed
        self._scene.render.filepath = str(self._output)
        try:
            with silence():
                self._bpy.ops.render.render(write_still=True)
            content = self._output.read_bytes()
        finally:
            self._output.unlink(missing_ok=True)
        light = read_light(content, box.bottom - box.top, box.right - box.left, 4 if self.meshes else 3)
        light[..., :3] *= brightness
        return light

    def shows_metal(self, scene: Scene) -> list[bool]:
        """Of each object of a scene, whether the renderer makes it metal, because its mesh defines no material."""
        return shows_metal(self._bpy, scene)

    def sky(self, scene: Scene) -> Light:
        """Linear light (S, S, 3) of the sky behind the objects of a scene with a mesh."""
        assert self._world is not None
        return self._world.behind(scene)

    def _set_filter(self, points: int | None) -> None:
        """Set Blender's own pixel filter, or with points the only one whose width may be almost zero."""
        cycles = self._scene.cycles
        cycles.pixel_filter_type, cycles.filter_width = ("GAUSSIAN", 0.01) if points else ("BLACKMAN_HARRIS", 1.5)

    def _frame(self, box: Box, side: int) -> None:
        """Set the box as fractions of the image from the bottom left corner, which Blender truncates to whole pixels.

        The added half pixel ensures that rounding loses none.
        """
        render = self._scene.render
        render.resolution_x = render.resolution_y = side
        render.border_min_x, render.border_max_x = (box.left + 0.5) / side, (box.right + 0.5) / side
        render.border_min_y = (side - box.bottom + 0.5) / side
        render.border_max_y = (side - box.top + 0.5) / side


def _configure_image(scene: Any) -> None:
    """Set the image options that differ from Blender's factory settings."""
    render = scene.render
    render.engine = "CYCLES"
    render.threads_mode = "FIXED"
    render.threads = 1  # processes share the cores without loss, threads do not
    render.use_persistent_data = True  # meshes and shaders stay loaded between samples
    render.resolution_percentage = 100
    render.use_border = render.use_crop_to_border = True
    render.use_file_extension = False
    image = render.image_settings  # linear light, in a temporary file
    image.file_format, image.color_mode, image.color_depth, image.exr_codec = "OPEN_EXR", "RGB", "16", "NONE"


def _configure_tracer(cycles: Any, settings: Settings) -> None:
    """Set the options of the path tracer that differ from Blender's factory settings."""
    cycles.device = "CPU"
    # never changed: blue noise depends on the largest number of samples since the meshes were loaded, so that an
    # image with fewer samples would depend on the images before it
    cycles.samples = settings.samples
    cycles.use_adaptive_sampling = False  # would vary the number of samples, which is small anyway
    # the denoiser sometimes takes the default pattern's noise for texture
    cycles.sampling_pattern = "BLUE_NOISE"
    cycles.use_light_tree = True  # a fifth slower, but better than a fifth more samples
    cycles.max_bounces = 2  # objects colour each other once; more bounces change nothing measurable
    cycles.diffuse_bounces = cycles.glossy_bounces = 2
    cycles.transmission_bounces = cycles.volume_bounces = cycles.transparent_max_bounces = 0
    cycles.use_denoising = settings.denoised
    cycles.denoiser = "OPENIMAGEDENOISE"
    cycles.denoising_quality = "FAST"  # HIGH takes a quarter longer for half a dB
    cycles.denoising_input_passes = "RGB"  # albedo and normals made FAST worse; those of a mirror are noisy
    cycles.denoising_prefilter = "NONE"


def _configure_for_meshes(bpy: Any) -> None:
    """Change the options for transparent backgrounds, textures that may be transparent too, and dense reflections."""
    scene, metal = bpy.context.scene, bpy.data.materials["metal"]
    metal.node_tree.nodes["Principled BSDF"].inputs["Roughness"].default_value = ROUGHER
    scene.render.image_settings.color_mode = "RGBA"
    scene.render.film_transparent = True
    scene.cycles.transparent_max_bounces = 8
    scene.cycles.denoising_quality = "BALANCED"
    scene.cycles.denoising_input_passes = "RGB_ALBEDO_NORMAL"  # 2 dB better on textures


@contextmanager
def silence() -> Iterator[None]:
    """Discard what Blender's C code prints to the standard output and error."""
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

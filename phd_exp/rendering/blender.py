"""Scenes to pixels with Cycles: the one file that imports Blender."""

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
from typing import Any, NamedTuple

from phd_exp.records.errors import RenderError
from phd_exp.records.scenes import Scene
from phd_exp.rendering.pixels import Light, read_light
from phd_exp.rendering.stage import build_stage

X_LIBRARIES = "libx11-6 libxext6 libxfixes3 libxi6 libxrender1 libxkbcommon0 libsm6 libice6 libgl1"


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


@dataclass(frozen=True)
class Settings:
    """How the tracer finds light.

    Attributes:
        samples: light paths a pixel.
        denoised: by Open Image Denoise.
        at_middles: the light at the middle of each pixel; else Blender's own mean over a pixel and its surroundings.
    """

    samples: int
    denoised: bool
    at_middles: bool


class Renderer:
    """Renders scenes; builds Blender's scene once and then only moves what differs.

    Blender keeps its state per process, so a second renderer in the same process takes the scene over.

    Raises:
        RenderError: bpy or a library it needs is missing.
    """

    def __init__(self, settings: Settings) -> None:
        self._output = _fast_folder() / f"phd_exp-{uuid.uuid4().hex}.exr"
        with silence():
            self._bpy = load_bpy()
            self._stage = build_stage(self._bpy)
            self._scene = self._bpy.context.scene
            _configure_image(self._scene)
            _configure_tracer(self._scene.cycles, settings)

    def render(self, scene: Scene, box: Box | None = None) -> Light:
        """Linear light of a box of pixels (height, width, 3), or of all (S, S, 3), rows from the top.

        1 is the brightest that a picture can show. A pure function of the scene, the box and the settings.
        """
        box = box or Box(0, 0, scene.S, scene.S)
        self._frame(box, scene.S)
        self._stage.show(scene)
        self._scene.cycles.seed = scene.noise_seed
        return read_light(self._shoot(), box.bottom - box.top, box.right - box.left)

    def _shoot(self) -> bytes:
        self._scene.render.filepath = str(self._output)
        try:
            with silence():
                self._bpy.ops.render.render(write_still=True)
            return self._output.read_bytes()
        finally:
            self._output.unlink(missing_ok=True)

    def _frame(self, box: Box, side: int) -> None:
        """Blender wants shares of the image from the bottom left corner, and cuts them off to whole pixels.

        Half a pixel more, and rounding cannot lose one.
        """
        render = self._scene.render
        render.resolution_x = render.resolution_y = side
        render.border_min_x, render.border_max_x = (box.left + 0.5) / side, (box.right + 0.5) / side
        render.border_min_y = (side - box.bottom + 0.5) / side
        render.border_max_y = (side - box.top + 0.5) / side


def _configure_image(scene: Any) -> None:
    """What differs from Blender's factory settings in the making of an image, with its reason."""
    render = scene.render
    render.engine = "CYCLES"
    render.threads_mode = "FIXED"
    render.threads = 1  # processes share the cores without loss, threads do not
    render.use_persistent_data = True  # meshes and shaders stay loaded between samples
    render.resolution_percentage = 100
    render.use_border = render.use_crop_to_border = True
    render.use_file_extension = False
    image = render.image_settings  # light as it is, in a file that is read in a moment
    image.file_format, image.color_mode, image.color_depth, image.exr_codec = "OPEN_EXR", "RGB", "16", "NONE"


def _configure_tracer(cycles: Any, settings: Settings) -> None:
    """The same for the path tracer."""
    cycles.device = "CPU"
    cycles.samples = settings.samples
    cycles.use_adaptive_sampling = False  # would spend a variable number of samples; there are few anyway
    cycles.sampling_pattern = (
        "BLUE_NOISE"  # the denoiser takes the default one's noise for texture now and then
    )
    cycles.use_light_tree = True  # a fifth slower, and worth more than a fifth more samples
    cycles.max_bounces = 2  # objects colour each other once; more changes nothing one can measure
    cycles.diffuse_bounces = cycles.glossy_bounces = 2
    cycles.transmission_bounces = cycles.volume_bounces = cycles.transparent_max_bounces = 0
    if settings.at_middles:
        cycles.pixel_filter_type = "GAUSSIAN"  # the one whose width may be next to nothing
        cycles.filter_width = 0.01
    cycles.use_denoising = settings.denoised
    cycles.denoiser = "OPENIMAGEDENOISE"
    cycles.denoising_quality = "FAST"  # HIGH takes a quarter longer for half a dB
    cycles.denoising_input_passes = "RGB"  # albedo and normals made FAST worse
    cycles.denoising_prefilter = "NONE"


def _fast_folder() -> Path:
    """A folder in memory where the system has one."""
    memory = Path("/dev/shm")
    return memory if os.access(memory, os.W_OK) else Path(tempfile.gettempdir())


@contextmanager
def silence() -> Iterator[None]:
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

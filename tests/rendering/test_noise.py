"""Images of a few samples are as clean on one material as on another."""

from collections.abc import Callable
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from scipy import ndimage

from phd_exp.records.scenes import Material, Scene
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.blender import Renderer, Settings
from phd_exp.rendering.objects import sample_object_scene
from phd_exp.rendering.rays import cylinder_mask, trace_pixels
from phd_exp.rendering.samples import fast_settings
from tests.support.meshes import solid, write_mesh

BORDER = 2  # px inside the silhouette: edges have errors of their own
EXACT = Settings(samples=1024, denoised=False, at_middles=False)

pytestmark = pytest.mark.slow


def test_metal_is_at_most_twice_as_noisy_as_rubber(make_spec: Callable[..., DatasetSpec], tmp_path: Path) -> None:
    file = write_mesh(tmp_path / "ball.stl", solid("sphere"))
    small = {"sensor_size": 40, "f_range": (640.0, 640.0), "z_range": (4.0, 4.0), "xy_range": 0.0}
    spec = make_spec("object", mesh=str(file), **small)
    images = {}
    for settings in (fast_settings(spec), EXACT):
        renderer = Renderer(settings, spec)
        scene = sample_object_scene(spec, "train", 0, renderer.meshes)
        for material in get_args(Material):
            light = renderer.render(_of(scene, material))[..., :3]
            images[material, settings] = 255 * light.clip(0, 1).mean(axis=-1) ** (1 / 2.2)
    inside = ndimage.binary_erosion(cylinder_mask(trace_pixels(scene, renderer.meshes)), iterations=BORDER)
    noise = {
        material: _noise(images[material, fast_settings(spec)] - images[material, EXACT], inside)
        for material in get_args(Material)
    }
    assert noise["metal"] <= 2 * noise["rubber"], noise


def _of(scene: Scene, material: Material) -> Scene:
    item = scene.objects[0].model_copy(update={"material": material})
    return scene.model_copy(update={"objects": (item,)})


def _noise(error: np.ndarray, inside: np.ndarray) -> float:
    """The standard deviation of white noise with the same median response; a highlight does not move it.

    Source: J. Immerkaer, "Fast noise variance estimation" (1996), with a median instead of the mean.
    """
    mask = np.outer([1, -2, 1], [1, -2, 1]) / 6  # white noise of deviation 1 has a response of deviation 1
    return float(1.4826 * np.median(np.abs(ndimage.convolve(error, mask))[inside]))

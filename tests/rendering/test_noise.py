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
from phd_exp.rendering.pixels import encoded
from phd_exp.rendering.rays import cylinder_mask, trace_pixels
from phd_exp.rendering.samples import fast_settings
from tests.support.meshes import solid, write_mesh

BORDER = 2  # px inside the silhouette: edges have errors of their own


@pytest.mark.parametrize("backdrops", [None, "hdri"])
def test_metal_is_at_most_twice_as_noisy_as_rubber(
    make_spec: Callable[..., DatasetSpec], tmp_path: Path, backdrops: str | None
) -> None:
    """The median error against 1,024 samples, in grey levels; a mirror's highlights do not move a median."""
    file = write_mesh(tmp_path / "ball.stl", solid("sphere"))
    small = {"sensor_size": 48, "f_range": (800.0, 800.0), "z_range": (4.0, 4.0), "xy_range": 0.0}
    spec = make_spec("object", mesh=str(file), backdrops=backdrops, **small)
    scenes, images = {}, {}
    for settings in (fast_settings(spec), Settings(samples=1024, denoised=False, at_middles=False)):
        renderer = Renderer(settings, spec)
        scene = sample_object_scene(spec, "train", 0, renderer.meshes)
        scenes = {material: _of(scene, material) for material in get_args(Material)}
        for material in scenes:
            images[material, settings.samples] = encoded(renderer.render(scenes[material])[..., :3]).astype(float)
    inside = ndimage.binary_erosion(cylinder_mask(trace_pixels(scene, renderer.meshes)), iterations=BORDER)
    noise = {
        material: np.median(np.abs(images[material, spec.samples_per_pixel] - images[material, 1024])[inside])
        for material in scenes
    }
    assert noise["metal"] <= 2 * noise["rubber"], noise


def _of(scene: Scene, material: Material) -> Scene:
    item = scene.objects[0].model_copy(update={"material": material})
    return scene.model_copy(update={"objects": (item,)})

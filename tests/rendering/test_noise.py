"""Images of a few samples are nearly as clean on metal as on rubber: none has speckles."""

from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from scipy import ndimage

from phd_exp.records.scenes import Material, Scene, Shape
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.blender import Renderer, Settings
from phd_exp.rendering.objects import sample_object_scene
from phd_exp.rendering.rays import cylinder_mask, trace_pixels
from phd_exp.rendering.samples import fast_settings, front_light
from tests.support.meshes import solid, write_mesh
from tests.support.renders import MakeSpec

BORDER = 2  # px inside the silhouette: edges have errors of their own
SCENES = 2
EXACT = Settings(samples=1024, denoised=False, points=None)

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("shape", "backdrops", "side"), [*product(("sphere", "cube"), ("hdri", None), (48, 80))], ids=str
)
def test_metal_is_at_most_twice_as_noisy_as_rubber(
    of_mesh: MakeSpec, tmp_path: Path, shape: Shape, backdrops: str | None, side: int
) -> None:
    """At 8 samples; the sphere's diameter is `side` px."""
    file = write_mesh(tmp_path / "mesh.glb", solid(shape))
    f = 20.0 * side
    size = {"sensor_size": 5 * side // 4, "f_range": (f, f), "z_range": (4.0, 4.0), "xy_range": 0.0}
    spec = of_mesh(mesh=str(file), backdrops=backdrops, samples_per_pixel=8, **size)
    fast, exact = (dict(_images(settings, spec)) for settings in (fast_settings(spec), EXACT))
    noise = {
        material: np.mean([_noise(fast[key][0] - exact[key][0], fast[key][1]) for key in fast if key[1] == material])
        for material in get_args(Material)
    }
    assert noise["metal"] <= 2 * noise["rubber"], noise


def _images(
    settings: Settings, spec: DatasetSpec
) -> Iterator[tuple[tuple[int, Material], tuple[np.ndarray, np.ndarray]]]:
    """The grey values of each scene with each material, and the pixels inside the silhouette."""
    renderer = Renderer(settings, spec)
    for number in range(SCENES):
        scene = sample_object_scene(spec, "train", number, renderer.meshes)
        hits = trace_pixels(scene, renderer.meshes)
        inside = ndimage.binary_erosion(cylinder_mask(hits), iterations=BORDER)
        for material in get_args(Material):
            made = _of(scene, material)
            light = renderer.render(made) if settings == EXACT else front_light(renderer, made, hits)
            yield (number, material), (255 * light[..., :3].clip(0, 1).mean(axis=-1) ** (1 / 2.2), inside)


def _of(scene: Scene, material: Material) -> Scene:
    item = scene.objects[0].model_copy(update={"material": material})
    return scene.model_copy(update={"objects": (item,)})


def _noise(error: np.ndarray, inside: np.ndarray) -> float:
    """The standard deviation of white noise with the same median response; a highlight does not move it.

    Source: J. Immerkaer, "Fast noise variance estimation" (1996), with a median instead of the mean.
    """
    mask = np.outer([1, -2, 1], [1, -2, 1]) / 6  # white noise of deviation 1 has a response of deviation 1
    return float(1.4826 * np.median(np.abs(ndimage.convolve(error, mask))[inside]))

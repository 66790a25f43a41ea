"""A process that paints samples of a data set in one of three ways, and says of each how long it took.

`python painter.py KIND SPECIFICATION FOLDER SAMPLES INDEX...` writes FOLDER/INDEX.png, and a JSON line each.

reference      Blender's own picture at 1024 samples a pixel, without denoiser
ours           as `phd_exp render` makes it
conventional   as generators after CLEVR do: the base scene's file opened anew for every image, the whole picture
               by one Blender with all its threads, no denoiser, and two flat renders that count the cylinder's
               pixels with and without what hides it; all else as Blender's factory settings have it
"""

import io
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from phd_exp.records.scenes import SHAPES, Scene
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.blender import Renderer, Settings, load_bpy, silence
from phd_exp.rendering.pixels import encoded
from phd_exp.rendering.samples import fast_settings, make_sample
from phd_exp.rendering.sampling import sample_scene
from phd_exp.rendering.stage import SURFACES, build_stage, show_scene

Paint = Callable[[Scene, int, Path], None]


def reference(spec: DatasetSpec, folder: Path, samples: int) -> Paint:
    # Blender's own picture, as good as converged
    renderer = Renderer(Settings(samples=1024, denoised=False, points=None))
    return lambda scene, index, path: Image.fromarray(encoded(renderer.render(scene))).save(path)


def ours(spec: DatasetSpec, folder: Path, samples: int) -> Paint:
    renderer = Renderer(fast_settings(spec))

    def paint(scene: Scene, index: int, path: Path) -> None:
        with Image.open(io.BytesIO(make_sample(renderer, spec, "test", index)[0])) as image:
            image.save(path)

    return paint


def conventional(spec: DatasetSpec, folder: Path, samples: int) -> Paint:
    bpy = load_bpy()
    base, flat = folder / "base.blend", folder / "flat.png"
    _write_base_scene(bpy, base, spec.sensor_size, samples)

    def paint(scene: Scene, index: int, path: Path) -> None:
        with silence():
            bpy.ops.wm.open_mainfile(filepath=str(base))
        show_scene(bpy, scene)
        bpy.context.scene.cycles.seed = scene.noise_seed
        _shoot(bpy, path)
        _flatten(bpy)
        together = _red_pixels(bpy, flat)
        for shape in SHAPES[1:]:
            bpy.data.objects[shape].hide_render = True
        alone = _red_pixels(bpy, flat)
        path.with_suffix(".json").write_text(json.dumps({"visibility": together / max(alone, 1)}))

    return paint


def _write_base_scene(bpy: Any, base: Path, side: int, samples: int) -> None:
    with silence():
        build_stage(bpy)
        scene = bpy.context.scene
        scene.render.engine = "CYCLES"
        scene.render.resolution_x = scene.render.resolution_y = side
        scene.render.resolution_percentage = 100
        scene.view_settings.view_transform = "Standard"
        scene.cycles.device = "CPU"
        scene.cycles.samples = samples
        scene.cycles.use_denoising = False
        _add_flat_material(bpy)
        for name in (*SURFACES, "flat"):
            bpy.data.materials[name].use_fake_user = True  # or the file would not keep what nothing wears yet
        bpy.ops.wm.save_as_mainfile(filepath=str(base))


def _add_flat_material(bpy: Any) -> None:
    tree = bpy.data.materials.new("flat").node_tree
    tree.nodes.clear()
    shader, output, info = (
        tree.nodes.new(f"ShaderNode{kind}") for kind in ("Emission", "OutputMaterial", "ObjectInfo")
    )
    tree.links.new(info.outputs["Color"], shader.inputs["Color"])
    tree.links.new(shader.outputs["Emission"], output.inputs["Surface"])


def _flatten(bpy: Any) -> None:
    bpy.context.scene.cycles.samples = 1
    for shape in SHAPES:
        item = bpy.data.objects[shape]
        item.material_slots[0].material = bpy.data.materials["flat"]
        item.color = (1.0, 0.0, 0.0, 1.0) if shape == "cylinder" else (0.0, 1.0, 0.0, 1.0)


def _shoot(bpy: Any, path: Path) -> None:
    bpy.context.scene.render.filepath = str(path)
    with silence():
        bpy.ops.render.render(write_still=True)


def _red_pixels(bpy: Any, path: Path) -> int:
    _shoot(bpy, path)
    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    return int((pixels[..., 0] - pixels[..., 1] > 100).sum())


def main(kind: str, spec: str, folder: str, samples: str, *indices: str) -> None:
    specification = DatasetSpec.model_validate_json(spec)
    ways = {"reference": reference, "ours": ours, "conventional": conventional}
    paint = ways[kind](specification, Path(folder), int(samples))
    for index in map(int, indices):
        scene = sample_scene(specification, "test", index)
        begun = time.perf_counter()
        paint(scene, index, Path(folder) / f"{index}.png")
        print(json.dumps({"index": index, "seconds": time.perf_counter() - begun}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])

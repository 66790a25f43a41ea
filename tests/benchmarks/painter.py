"""A process that paints samples of a data set.

`python painter.py KIND SPECIFICATION FOLDER INDEX...` writes FOLDER/INDEX.png, and a JSON line each.

reference      Blender's own picture at 1024 samples a pixel, without denoiser
ours           as `phd_exp render` makes it
"""

import io
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

from PIL import Image

from phd_exp.records.scenes import Scene
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.blender import Renderer, Settings
from phd_exp.rendering.pixels import encoded
from phd_exp.rendering.samples import fast_settings, make_sample
from phd_exp.rendering.sampling import sample_scene

Paint = Callable[[Scene, int, Path], None]


def reference(spec: DatasetSpec) -> Paint:
    # Blender's own picture, as good as converged
    renderer = Renderer(Settings(samples=1024, denoised=False, points=None))
    return lambda scene, index, path: Image.fromarray(encoded(renderer.render(scene))).save(path)


def ours(spec: DatasetSpec) -> Paint:
    renderer = Renderer(fast_settings(spec))

    def paint(scene: Scene, index: int, path: Path) -> None:
        with Image.open(io.BytesIO(make_sample(renderer, spec, "test", index)[0])) as image:
            image.save(path)

    return paint


def main(kind: str, spec: str, folder: str, *indices: str) -> None:
    specification = DatasetSpec.model_validate_json(spec)
    paint = {"reference": reference, "ours": ours}[kind](specification)
    for index in map(int, indices):
        scene, begun = sample_scene(specification, "test", index), time.perf_counter()
        paint(scene, index, Path(folder) / f"{index}.png")
        print(json.dumps({"index": index, "seconds": time.perf_counter() - begun}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])

"""Helpers of the tests that render: contents of a folder, waiting, and a render in a separate process."""

import io
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from phd_exp.records.dataset import SPLITS, DatasetFolder
from phd_exp.records.scenes import SampleRecord, Scene, SceneObject, Split
from phd_exp.records.spec import DatasetSpec, Shard
from phd_exp.rendering.objects import sample_object_scene
from phd_exp.rendering.rays import NOTHING, Hits, Mask, trace_pixels
from phd_exp.rendering.samples import describe
from phd_exp.rendering.sampling import sample_scene
from phd_exp.rendering.sealing import side_file, side_files
from phd_exp.rendering.triangles import NO_MESHES, Meshes
from phd_exp.rendering.worker import make

MakeSpec = Callable[..., DatasetSpec]
"""The fixture `make_spec`."""
UNLIKELY = 1e-3  # the seeds are fixed: a law either holds at this level for ever or never
SMALL_MESH: dict[str, Any] = {"sensor_size": 56, "f_range": (300.0, 500.0), "xy_range": 0.2, "backdrops": None}
"""Values of a data set with a mesh whose images are cheap."""
RENDER = {"shard": None, "verify": False, "rerender": 0, "masks": None, "bop": None}  # the keys of conf/render.yaml
ROOT = Path(__file__).parents[2]
PATIENCE = 60.0  # s
N_TRAIN, N_TEST = 12, 4
"""Samples of the fixture `small`."""
VARIANTS = ("default", "occl", "scale", "occl_scale")


def contents(folder: DatasetFolder) -> dict[str, bytes]:
    """All files of a data set except its cache."""
    files = (path for path in folder.root.rglob("*") if path.is_file() and folder.cache not in path.parents)
    return {str(path.relative_to(folder.root)): path.read_bytes() for path in files}


def written(folder: DatasetFolder) -> dict[Path, int]:
    """When each image on disk was written, ns."""
    return {path: path.stat().st_mtime_ns for path in folder.root.rglob("*.png")}


def made(folder: DatasetFolder) -> dict[Path, int]:
    """The images with a side file, each of which is whole, and when they were written, ns."""
    sides = [(split, path) for split in SPLITS for path in side_files(folder, split)]
    images = [folder.split_folder(split) / json.loads(path.read_bytes())["file_name"] for split, path in sides]
    for path in images:
        decoded(path.read_bytes())
    return {path: path.stat().st_mtime_ns for path in images}


def unsealed(folder: DatasetFolder) -> None:
    """As a kill just before the end leaves a folder: all images, and all side files."""
    for split in SPLITS:
        for record in folder.records(split):
            side_file(folder, split, record.index).write_text(record.model_dump_json() + "\n")
    for split in SPLITS:
        folder.metadata_path(split).unlink(missing_ok=True)
    folder.write_manifest(folder.manifest.model_copy(update={"splits": {}}))


def decoded(content: bytes) -> np.ndarray:
    """The pixels (height, width, 3) of an image file."""
    with Image.open(io.BytesIO(content)) as image:
        assert image.mode == "RGB"
        return np.asarray(image)


def pixels(folder: DatasetFolder, record: SampleRecord) -> np.ndarray:
    """The pixels (S, S, 3) of a sample, as signed integers."""
    array = decoded((folder.split_folder(record.split) / record.file_name).read_bytes())
    assert array.shape == (record.S, record.S, 3)
    return array.astype(int)


def wait_until(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.005)


def copying(source: DatasetFolder, seconds: float = 0.0) -> Callable[..., Iterator[tuple[tuple[Split, int], bool]]]:
    """`render_all` whose images are copies, each after a pause: for laws of what is rendered when."""
    records = {split: source.records(split) for split in SPLITS}

    def paint(spec: DatasetSpec, split: Split, index: int) -> tuple[bytes, SampleRecord]:
        time.sleep(seconds)
        print("copied", split, index, file=sys.stderr)
        return source.image_path(split, index).read_bytes(), records[split][index]

    def render_all(
        folder: DatasetFolder, spec: DatasetSpec, samples: Sequence[tuple[Split, int]], workers: int, *, waits: bool
    ) -> Iterator[tuple[tuple[Split, int], bool]]:
        for sample in samples:
            yield sample, make(folder, spec, sample, paint, waits=waits)

    return render_all


@contextmanager
def rendering_elsewhere(
    folder: DatasetFolder,
    spec: DatasetSpec,
    workers: int = 1,
    n: tuple[int, int] = (N_TRAIN, N_TEST),
    shard: Shard | None = None,
    source: DatasetFolder | None = None,
    seconds: float = 0.03,
) -> Iterator[subprocess.Popen[str]]:
    """`ensure_rendered` in its own process group, which is killed at the end.

    With a `source`, its images are copied, slowly.
    """
    stand_in = f"render.render_all = copying(DatasetFolder({str(source.root)!r}), {seconds})" if source else ""
    script = (
        # a shell makes background processes ignore interrupts, and this process would inherit that
        "import signal\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from phd_exp.records.dataset import DatasetFolder\n"
        "from phd_exp.records.spec import DatasetSpec, Shard\n"
        "from phd_exp.rendering import render\n"
        "from tests.support.renders import copying\n"
        f"{stand_in}\n"
        f"spec = DatasetSpec.model_validate_json({spec.model_dump_json()!r})\n"
        f"render.ensure_rendered(DatasetFolder({str(folder.root)!r}), spec, *{n}, {workers}, shard={shard!r})\n"
    )
    options: dict[str, Any] = {"stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    with subprocess.Popen([sys.executable, "-c", script], cwd=ROOT, **options) as process:
        try:
            yield process
        finally:
            process.kill()


def silhouettes(hits: Hits) -> Mask:
    """Pixels (S, S) that show any object, rows from the top."""
    return np.asarray((hits.surfaces != NOTHING).any(axis=0))


def drawn(spec: DatasetSpec, n: int, meshes: Meshes, split: Split = "train") -> list[Scene]:
    """The first scenes of a mesh."""
    return [sample_object_scene(spec, split, index, meshes) for index in range(n)]


def described(spec: DatasetSpec, split: Split, index: int, meshes: Meshes = NO_MESHES) -> SampleRecord:
    """The record of a sample without its image."""
    scene = sample_object_scene(spec, split, index, meshes) if spec.mesh else sample_scene(spec, split, index)
    return describe(spec, split, index, scene, trace_pixels(scene, meshes), "0" * 64, meshes)


def placed(scene: Scene, **changes: Any) -> SceneObject:
    """A scene's cylinder, upright and of size one, with some changes."""
    straight = {"rotation": (1.0, 0.0, 0.0, 0.0), "scale": 1.0}
    return scene.objects[0].model_copy(update=straight | changes)


def with_objects(scene: Scene, *objects: SceneObject) -> Scene:
    """A scene with other objects, which need not include a cylinder."""
    return scene.model_copy(update={"objects": objects})

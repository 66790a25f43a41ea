"""Where images show their objects: arrays that training reads, and images of masks.

The masks follow from the records by ray casting; Blender only reads the meshes.
"""

import io
import json
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rich.console import Console
from rich.progress import track

from phd_exp.records.dataset import CELLS, DRAWING, SPLITS, DatasetFolder
from phd_exp.records.errors import DatasetError, writing
from phd_exp.records.files import remove_temporaries, write_atomic
from phd_exp.records.processes import held
from phd_exp.records.scenes import SampleRecord
from phd_exp.records.spec import DatasetSpec
from phd_exp.records.written import Written
from phd_exp.rendering.blender import Renderer
from phd_exp.rendering.pixels import file_of
from phd_exp.rendering.progress import shown_progress
from phd_exp.rendering.rays import NOTHING, beyond_edges, cylinder_mask, trace_pixels
from phd_exp.rendering.samples import fast_settings
from phd_exp.rendering.triangles import NO_MESHES, Meshes

RAYS = 4  # along each side of a cell


def meshes_of(spec: DatasetSpec) -> Meshes:
    """The meshes of a data set, read by Blender. Raises RenderError if one cannot be read."""
    return Renderer(fast_settings(spec), spec).meshes if spec.mesh else NO_MESHES


def ensure_drawn(folder: DatasetFolder, spec: DatasetSpec, n: int) -> None:
    """Draw masks, and of a mesh clearings, of all training images, unless those of the first `n` are on disk.

    Processes that draw in the same folder wait for each other.

    Raises RenderError if the folder cannot be written or a mesh cannot be read, DatasetError if a record is broken.
    """
    names = ["masks.npy", "clearings.npy"] if spec.mesh else ["masks.npy"]
    if n == 0 or spec.empty or not _missing(folder, names, n):
        return
    with writing(folder.root):
        folder.cache.mkdir(exist_ok=True)
        with held(folder.cache / "drawing.lock", waiting=f"{folder.root}: waiting for the masks of another process"):
            remove_temporaries(folder.root)  # of killed processes
            if missing := _missing(folder, names, n):
                _draw(folder, missing, meshes_of(spec))


def _missing(folder: DatasetFolder, names: list[str], n: int) -> list[str]:
    """Those arrays that do not hold the first `n` images, drawn by the present version."""
    missing = []
    for name in names:
        try:
            folder.drawn(name, n)
        except DatasetError:
            missing.append(name)
    return missing


def _draw(folder: DatasetFolder, names: list[str], meshes: Meshes) -> None:
    """Write arrays of all training images, and then their version."""
    records, console = folder.records("train"), Console(stderr=True)
    for name in names:
        words, draw, head = f"drawing {name.removesuffix('.npy')} once", DRAW[name], io.BytesIO()
        shape = (len(records), *draw(records[0], meshes).shape)
        np.lib.format.write_array_header_1_0(head, {"descr": "|u1", "fortran_order": False, "shape": shape})
        shown = track(records, words, console=console, transient=True, disable=not console.is_terminal)
        rows = (draw(record, meshes).tobytes() for record in shown)
        file = folder.root / name
        write_atomic(file, chain([head.getvalue()], rows))
        write_atomic(file.with_suffix(".json"), json.dumps(DRAWING) + "\n")


def mask(record: SampleRecord, meshes: Meshes) -> NDArray[np.uint8]:
    """The share of each cell of the image that shows the object, 0 to 255: a row (CELLS, CELLS) of `masks.npy`."""
    side = CELLS * RAYS
    scene = record.as_scene.model_copy(update={"S": side, "f": record.f * side / record.S})
    shown = cylinder_mask(trace_pixels(scene, meshes))
    share = shown.reshape(CELLS, RAYS, CELLS, RAYS).mean((1, 3))
    return np.rint(255 * share).astype(np.uint8)


def clearing(record: SampleRecord, meshes: Meshes) -> NDArray[np.uint8]:
    """The pixels that show no object and lie in the user's image, as bits: a row (S, S / 8) of `clearings.npy`."""
    clear = trace_pixels(record.as_scene, meshes).first == NOTHING
    return np.packbits(clear & ~beyond_edges(record.as_scene), axis=-1)


DRAW = {"masks.npy": mask, "clearings.npy": clearing}


def write_masks(folder: DatasetFolder, masks: Path, meshes: Meshes = NO_MESHES) -> int:
    """Write `<masks>/<split>/<index>.png`, one bit per pixel, 1 where the object is visible; returns how many.

    Raises DatasetError if there is no data set, or a broken one, RenderError if the masks cannot be written.
    """
    records = [record for split in SPLITS for record in folder.records(split)]
    names = [f"{record.split}/{Path(record.file_name).stem}.png" for record in records]
    with writing(masks, instead="masks=FOLDER"), Written(masks, "masks") as written:
        written.require(*names)
        with shown_progress(len(records), "drawing masks") as advance:
            for record, name in zip(records, names, strict=True):
                image = Image.fromarray(cylinder_mask(trace_pixels(record.as_scene, meshes)))
                written.write(name, file_of(image, "png"))
                advance()
    return len(records)

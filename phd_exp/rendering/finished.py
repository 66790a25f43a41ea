"""Verify a finished data set against its manifest and specification."""

import io
import json
import random
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from phd_exp.records.dataset import SPLITS, DatasetFolder, Seal
from phd_exp.records.errors import DatasetError, RenderError, UserError, one_line
from phd_exp.records.files import checksum
from phd_exp.records.images import recorded_image
from phd_exp.records.processes import announce
from phd_exp.records.scenes import SampleRecord, Split
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.blender import Renderer, renderer_version, require_bpy
from phd_exp.rendering.progress import shown_progress
from phd_exp.rendering.samples import fast_settings, make_sample
from phd_exp.rendering.sampling import generator_version
from phd_exp.rendering.sealing import other_make, side_files

DIGITS = 9  # after the point, to which numbers of records agree on all processors and between versions
LEVEL = 1.0  # of 255, root mean square, within which images do: the path tracer and the denoiser are less exact


def verify(folder: DatasetFolder, spec: DatasetSpec, rerender: int, seed: int | None = None) -> int:
    """Check a whole data set and render `rerender` of its samples again; returns the number of samples checked.

    Each image is compared with its checksum and decoded, each line of metadata is compared with the manifest. The
    samples to render again are drawn at random with `seed`; their images and records must come out the same, up to
    the rounding errors of another processor.

    Raises:
        RenderError: one line for each fault, with its remedy.
        DatasetError: the folder holds no such data set.
        RenderError: samples are to be rendered again, and bpy is missing.
    """
    manifest = folder.require(spec)
    if rerender:
        require_bpy()
    if rerender and other_make(manifest):
        raise DatasetError(
            f"{folder.root}: made by generator {manifest.generator} with {manifest.renderer}, this is generator "
            f"{generator_version(spec)} with {renderer_version()}: its images cannot be compared; verify files alone "
            "by rerender=0"
        )
    wrong: list[str] = []
    sound: list[SampleRecord] = []
    records = [record for split in SPLITS for record in _metadata(folder, split, manifest.splits.get(split), wrong)]
    with shown_progress(len(records), f"verifying {spec.variant}") as advance:
        for record in records:
            path = folder.split_folder(record.split) / record.file_name
            try:
                recorded_image(path, record)
                sound.append(record)
            except DatasetError as error:
                first = "delete it, and " if path.exists() else ""
                wrong.append(f"{error}; {first}`render` makes it again")
            advance()
    wrong += _rendered_again(folder, spec, random.Random(seed).sample(sound, min(rerender, len(sound))))
    if wrong:
        raise RenderError("\n".join(map(one_line, wrong)))
    return len(sound)


def _metadata(folder: DatasetFolder, split: Split, seal: Seal | None, wrong: list[str]) -> list[SampleRecord]:
    """The records of a split. Faults of their file, and images without a line, are added to `wrong`."""
    if seal is None or not seal.n:
        return []
    path, records = folder.metadata_path(split), list[SampleRecord]()
    if path.exists() and checksum(path) != seal.metadata_sha256:
        wrong.append(f"{path}: its checksum is not that of the manifest; restore it, or render the data set anew")
    try:
        records = folder.records(split)
    except UserError as error:
        wrong.append(str(error))
    if records and not side_files(folder, split):  # a render under way has images that are not sealed yet
        for name in sorted(folder.images(split) - {record.file_name for record in records}):
            wrong.append(f"{folder.split_folder(split) / name}: no line of metadata.jsonl names it; delete it")
    return records


def _rendered_again(folder: DatasetFolder, spec: DatasetSpec, records: list[SampleRecord]) -> Iterator[str]:
    """The differences between samples that are rendered again and those on disk."""
    if not records:
        return
    names = ", ".join(f"{record.split}/{record.file_name}" for record in records)
    announce(f"rendering {len(records)} samples again: {names}")
    renderer = Renderer(fast_settings(spec), spec)
    for record in records:
        image, again = make_sample(renderer, spec, record.split, record.index)
        path = folder.split_folder(record.split) / record.file_name
        rounded = partial(json.loads, parse_float=lambda number: round(float(number), DIGITS))
        new, old = (rounded(one.model_dump_json(exclude={"sha256"})) for one in (again, record))
        for key in filter(lambda key: new[key] != old.get(key), new):
            yield f"{path}: recorded {key}={getattr(record, key)}, rendering it again gives {getattr(again, key)}"
        one, other = (np.asarray(Image.open(io.BytesIO(file)), float) for file in (image, path.read_bytes()))
        if one.shape != other.shape or ((one - other) ** 2).mean() > LEVEL**2:
            yield f"{path}: rendering it again gives another image; delete the data set, and `render` makes it again"


def require_elsewhere(folder: DatasetFolder, **places: Path | None) -> None:
    """Raise RenderError if a place to write to lies inside the data set, where loaders would take it for samples."""
    for key, place in places.items():
        if place and place.absolute().is_relative_to(folder.root):
            raise RenderError(f"{key}={place}: lies in the data set itself; expected a folder outside {folder.root}")

"""Whether a data set on disk is what its manifest says, and what its specification gives."""

import random
from collections.abc import Iterator
from pathlib import Path

from phd_exp.records.dataset import SPLITS, DatasetFolder, Manifest, Seal, checksum
from phd_exp.records.errors import DatasetError, UserError
from phd_exp.records.images import recorded_image
from phd_exp.records.scenes import SampleRecord, Split
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.blender import Renderer, renderer_version, require_bpy
from phd_exp.rendering.progress import announce, shown_progress
from phd_exp.rendering.sampling import GENERATOR_VERSION
from phd_exp.rendering.sealing import other_make
from phd_exp.rendering.worker import fast_settings, make_sample


def verify(folder: DatasetFolder, spec: DatasetSpec, rerender: int, seed: int | None = None) -> int:
    """Check a whole data set, and render `rerender` samples of it again; returns the number of samples checked.

    Every image is read, held against its checksum and decoded; every line of metadata against the manifest. The
    samples to render again are drawn at random, by `seed` where one is given; their images and lines have to come out
    the same to the last bit.

    Raises:
        DatasetError: a line for each thing that is wrong, with what to do; or there is no such data set here.
        RenderError: samples are to be rendered again, and bpy is missing.
    """
    manifest = folder.require(spec)
    if rerender:
        require_bpy()
        _require_same_make(folder, manifest)
    wrong: list[str] = []
    sound: list[SampleRecord] = []
    records: list[SampleRecord] = []
    for split in SPLITS:
        found, faults = _metadata(folder, split, manifest.splits.get(split))
        records += found
        wrong += [*faults, *_strangers(folder, split, found)]
    with shown_progress(len(records), f"verifying {spec.variant}") as advance:
        for record in records:
            fault = _fault(folder.split_folder(record.split) / record.file_name, record)
            if fault:
                wrong.append(fault)
            else:
                sound.append(record)
            advance()
    wrong += _rendered_again(folder, spec, random.Random(seed).sample(sound, min(rerender, len(sound))))
    if wrong:
        raise DatasetError("\n".join(wrong))
    return len(sound)


def _metadata(folder: DatasetFolder, split: Split, seal: Seal | None) -> tuple[list[SampleRecord], list[str]]:
    """The records of a split, and what is wrong with the file that holds them."""
    if seal is None or not seal.n:
        return [], []
    path, faults = folder.metadata_path(split), []
    if path.exists() and checksum(path) != seal.metadata_sha256:
        faults.append(
            f"{path}: its checksum is not that of the manifest; restore it, or render the data set anew"
        )
    try:
        return folder.records(split), faults
    except UserError as error:
        return [], [*faults, str(error)]


def _strangers(folder: DatasetFolder, split: Split, records: list[SampleRecord]) -> Iterator[str]:
    """Images without a line of metadata: a loader of images would take them for samples."""
    if not records or folder.journals(split):
        return  # a render under way, or broken off, has images that are not sealed yet
    for name in sorted(folder.images(split) - {record.file_name for record in records}):
        yield f"{folder.split_folder(split) / name}: no line of metadata.jsonl names it; delete it"


def _fault(path: Path, record: SampleRecord) -> str | None:
    try:
        recorded_image(path, record)
    except DatasetError as error:
        advice = "delete it, and `render` makes it again" if path.exists() else "`render` makes it again"
        return f"{error}; {advice}"
    return None


def _require_same_make(folder: DatasetFolder, manifest: Manifest) -> None:
    if other_make(manifest):
        raise DatasetError(
            f"{folder.root}: made by generator {manifest.generator} with {manifest.renderer}, this is generator "
            f"{GENERATOR_VERSION} with {renderer_version()}: its images cannot be compared; verify files alone by "
            "rerender=0"
        )


def _rendered_again(folder: DatasetFolder, spec: DatasetSpec, records: list[SampleRecord]) -> Iterator[str]:
    """What comes out otherwise than it lies on disk."""
    if not records:
        return
    announce(f"rendering {len(records)} samples again: {', '.join(_name(record) for record in records)}")
    renderer = Renderer(fast_settings(spec))
    for record in records:
        image, again = make_sample(renderer, spec, record.split, record.index)
        path = folder.split_folder(record.split) / record.file_name
        for key in SampleRecord.model_fields:
            if getattr(again, key) != getattr(record, key) and key != "sha256":
                yield f"{path}: recorded {key}={getattr(record, key)}, rendering it again gives {getattr(again, key)}"
        if image != path.read_bytes():
            yield f"{path}: rendering it again gives another image; delete the data set, and `render` makes it again"


def _name(record: SampleRecord) -> str:
    return f"{record.split}/{record.file_name}"

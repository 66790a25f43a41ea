"""From side files to a finished folder: its first manifest, the samples that are made, and the last writing.

A sample is made when its image and then its side file, `.cache/rendered/<split>/000123.json` with its record, are on
disk. Sealing turns the records into `metadata.jsonl`.
"""

import shutil
from pathlib import Path

from phd_exp.records.dataset import SPLITS, DatasetFolder, Manifest, Seal, image_name, sha256
from phd_exp.records.errors import CorruptFileError, DatasetError
from phd_exp.records.files import read_jsonl, remove_temporaries, write_atomic
from phd_exp.records.processes import announce, held
from phd_exp.records.scenes import SampleRecord, Split
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.blender import renderer_version
from phd_exp.rendering.masks import DRAW
from phd_exp.rendering.sampling import generator_version

Sample = tuple[Split, int]
"""Split and index of a sample."""


def begin(folder: DatasetFolder, spec: DatasetSpec) -> None:
    """Write the manifest, which names the data set, before the first image, unless there is one.

    Raises:
        DatasetError: the folder holds another data set, or another generator or Blender made it, whose samples would
            not match the rest.
    """
    with held(folder.render_lock, waiting=f"{folder.root}: waiting for the manifest"):
        for split in SPLITS:
            folder.split_folder(split).mkdir(exist_ok=True)
        if not folder.manifest_path.exists():
            for name in DRAW:  # of another data set that was here
                for file in (folder.root / name, (folder.root / name).with_suffix(".json")):
                    file.unlink(missing_ok=True)
            shutil.rmtree(folder.cache / "rendered", ignore_errors=True)
            folder.write_manifest(
                Manifest(generator=generator_version(spec), renderer=renderer_version(), spec=spec, splits={})
            )
        for split in SPLITS:
            side_file(folder, split, 0).parent.mkdir(parents=True, exist_ok=True)
        for key, theirs, ours in other_make(folder.require(spec)):
            raise DatasetError(
                f"{folder.root}: begun with {key} {theirs}, this is {ours}, and the rest would not match; "
                "move the folder away or choose another data.root"
            )


def other_make(manifest: Manifest) -> list[tuple[str, int | str, int | str]]:
    """Differences between the programs that made a data set and the present ones: key, their version, ours."""
    generator = generator_version(manifest.spec)
    made = (("generator", manifest.generator, generator), ("renderer", manifest.renderer, renderer_version()))
    return [(key, theirs, ours) for key, theirs, ours in made if theirs != ours]


def side_file(folder: DatasetFolder, split: Split, index: int) -> Path:
    """The record of a sample, until the data set is sealed."""
    return folder.cache / "rendered" / split / f"{index:06d}.json"


def side_files(folder: DatasetFolder, split: Split) -> list[Path]:
    """Those on disk."""
    return list(side_file(folder, split, 0).parent.glob("*.json"))


def unmade(folder: DatasetFolder, spec: DatasetSpec, n_train: int, n_test: int) -> list[Sample]:
    """The wanted samples that are neither sealed nor made."""
    left: list[Sample] = []
    for split, indices in folder.missing(spec, n_train, n_test).items():
        images, sides = folder.images(split), {path.stem for path in side_files(folder, split)}
        is_made = (f"{i:06d}" in sides and image_name(i, spec.image_format) in images for i in indices)
        left += [(split, index) for index, made in zip(indices, is_made, strict=True) if not made]
    return left


def seal(folder: DatasetFolder, spec: DatasetSpec, n_train: int, n_test: int) -> bool:
    """Write `metadata.jsonl` and then the manifest, and remove the side files; returns whether all samples are there.

    If some are not made, the folder stays as it is. One process seals at a time; the others find the folder sealed.
    """
    with held(folder.render_lock, waiting=f"{folder.root}: another process writes the metadata"):
        if not any(folder.missing(spec, n_train, n_test).values()):
            return True
        if left := unmade(folder, spec, n_train, n_test):
            announce(f"{folder.root}: {len(left)} samples of other shards are missing")
            return False
        seals = {split: done for split in SPLITS if (done := _seal_split(folder, split)).n}
        remove_temporaries(folder.root)
        folder.write_manifest(folder.manifest.model_copy(update={"splits": seals}))
        for split, done in seals.items():
            for path in side_files(folder, split):
                if int(path.stem) < done.n:
                    path.unlink()
    return True


def _seal_split(folder: DatasetFolder, split: Split) -> Seal:
    """Write the records of the samples up to the first gap."""
    known = _records(folder, split)
    n = next(index for index in range(len(known) + 1) if index not in known)
    lines = "".join(known[index].model_dump_json() + "\n" for index in range(n))
    if lines:
        write_atomic(folder.metadata_path(split), lines)
    for path in folder.split_folder(split).glob("metadata.partial*.jsonl"):  # of earlier versions
        path.unlink()
    remove_temporaries(folder.split_folder(split))
    return Seal(n=n, metadata_sha256=sha256(lines.encode()))


def _records(folder: DatasetFolder, split: Split) -> dict[int, SampleRecord]:
    """The sealed records and those of side files, which are newer, of the samples whose images are there."""
    records = folder.records(split) if folder.metadata_path(split).exists() else []
    for path in side_files(folder, split):
        try:
            records += read_jsonl(path, SampleRecord.model_validate_json)
        except CorruptFileError as error:
            raise DatasetError(f"{error}; delete the file, and its image is rendered again") from error
    images = folder.images(split)
    return {record.index: record for record in records if record.file_name in images}

"""From images and journals to a finished folder: the samples known so far, and the order in which it is sealed.

Each shard has a journal, and so has a render without shards. A render that resumes takes the samples of all journals
as finished. Sealing removes the journals; it holds an exclusive lock, so that no other process is writing one.
"""

from contextlib import suppress

from phd_exp.records.dataset import SPLITS, DatasetFolder, Manifest, Seal, sha256
from phd_exp.records.errors import CorruptFileError, DatasetError, UserError
from phd_exp.records.files import read_jsonl, remove_temporaries, write_atomic
from phd_exp.records.scenes import SampleRecord, Split
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.blender import renderer_version
from phd_exp.rendering.masks import DRAW, ensure_drawn
from phd_exp.rendering.sampling import generator_version

Wanted = dict[Split, int]
Known = dict[Split, dict[int, SampleRecord]]


def begin(folder: DatasetFolder, spec: DatasetSpec) -> None:
    """Write the manifest, which names the data set, before the first image, unless there is one.

    Raises:
        DatasetError: another generator or another Blender made the folder, whose samples would not match the rest.
    """
    for split in SPLITS:
        folder.split_folder(split).mkdir(exist_ok=True)
    if not folder.manifest_path.exists():
        for name in DRAW:  # of another data set that was here
            for file in (folder.root / name, (folder.root / name).with_suffix(".json")):
                file.unlink(missing_ok=True)
        manifest = Manifest(generator=generator_version(spec), renderer=renderer_version(), spec=spec, splits={})
        folder.write_manifest(manifest)
    for key, theirs, ours in other_make(folder.manifest):
        raise DatasetError(
            f"{folder.root}: begun with {key} {theirs}, this is {ours}, and the rest would not match; "
            "move the folder away or choose another data.root"
        )


def other_make(manifest: Manifest) -> list[tuple[str, int | str, int | str]]:
    """Differences between the programs that made a data set and the present ones: key, their version, ours."""
    generator = generator_version(manifest.spec)
    made = (("generator", manifest.generator, generator), ("renderer", manifest.renderer, renderer_version()))
    return [(key, theirs, ours) for key, theirs, ours in made if theirs != ours]


def known_samples(folder: DatasetFolder) -> Known:
    """Records of the samples whose image is on disk, from the sealed files and from all journals."""
    return {split: _known_of(folder, split) for split in SPLITS}


def _known_of(folder: DatasetFolder, split: Split) -> dict[int, SampleRecord]:
    # in the order in which sealing moves records, so that none is missed while another process seals
    plain = folder.journal_path(split)
    records: list[SampleRecord] = []
    for path in (*(set(folder.journals(split)) - {plain}), plain, folder.metadata_path(split)):
        try:
            with suppress(FileNotFoundError):
                records += read_jsonl(path, SampleRecord.model_validate_json)
        except CorruptFileError as error:
            raise DatasetError(f"{error}; remove that line, and its image is rendered again") from error
    images = folder.images(split)
    # reversed: a journal is newer than the sealed file
    return {record.index: record for record in reversed(records) if record.file_name in images}


def missing(known: Known, wanted: Wanted) -> list[tuple[Split, int]]:
    """Split and index of each wanted sample that is not known."""
    return [(split, index) for split in SPLITS for index in range(wanted[split]) if index not in known[split]]


def seal(folder: DatasetFolder, spec: DatasetSpec, known: Known) -> None:
    """Write `metadata.jsonl`, remove the journals, count the samples in the manifest, and draw masks, in this order.

    The caller holds `render.lock` exclusively.
    """
    seals = {split: done for split in SPLITS if (done := _seal_split(folder, split, known[split])).n}
    remove_temporaries(folder.root)
    folder.write_manifest(folder.manifest.model_copy(update={"splits": seals}))
    with suppress(UserError):  # a training that needs masks reports that they are missing
        ensure_drawn(folder, spec, folder.manifest.count("train"))


def _seal_split(folder: DatasetFolder, split: Split, known: dict[int, SampleRecord]) -> Seal:
    """Turn the samples up to the first gap into `metadata.jsonl`; those beyond it stay in the plain journal."""
    n = next(index for index in range(len(known) + 1) if index not in known)
    lines, beyond = (
        "".join(known[index].model_dump_json() + "\n" for index in indices)
        for indices in (range(n), sorted(index for index in known if index > n))
    )
    plain = folder.journal_path(split)
    for path, text in ((folder.metadata_path(split), lines), (plain, beyond)):
        if text:
            write_atomic(path, text)
    for journal in folder.journals(split):
        if not beyond or journal != plain:
            journal.unlink()
    remove_temporaries(folder.split_folder(split))
    return Seal(n=n, metadata_sha256=sha256(lines.encode()))

"""From images and journals to a finished folder: what is known of it, and the order in which it is sealed.

Every writer has a journal of its own, an unsharded render the plain one; all of them count as finished work,
whoever goes on. Only one who holds the folder alone seals it, so that no journal is removed under its writer.
"""

from contextlib import suppress

from phd_exp.records.dataset import SPLITS, DatasetFolder, Manifest, Seal, sha256
from phd_exp.records.errors import CorruptFileError, DatasetError
from phd_exp.records.files import read_jsonl, remove_temporaries, write_atomic
from phd_exp.records.scenes import SampleRecord, Split
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.blender import renderer_version
from phd_exp.rendering.sampling import GENERATOR_VERSION

Wanted = dict[Split, int]
Known = dict[Split, dict[int, SampleRecord]]


def begin(folder: DatasetFolder, spec: DatasetSpec) -> None:
    """Write the folder's manifest if there is none: before the first image, it says of which data set it is.

    Raises:
        DatasetError: the folder was made by another generator or another Blender: the rest would not match.
    """
    for split in SPLITS:
        folder.split_folder(split).mkdir(exist_ok=True)
    if not folder.manifest_path.exists():
        folder.write_manifest(
            Manifest(generator=GENERATOR_VERSION, renderer=renderer_version(), spec=spec, splits={})
        )
        return
    for key, theirs, ours in other_make(folder.manifest):
        raise DatasetError(
            f"{folder.root}: begun with {key} {theirs}, this is {ours}, and the rest would not match; "
            "move the folder away or choose another data.root"
        )


def other_make(manifest: Manifest) -> list[tuple[str, int | str, int | str]]:
    """What differs between the programmes that made a data set and these: its name, theirs, ours."""
    made = (
        ("generator", manifest.generator, GENERATOR_VERSION),
        ("renderer", manifest.renderer, renderer_version()),
    )
    return [(key, theirs, ours) for key, theirs, ours in made if theirs != ours]


def known_samples(folder: DatasetFolder) -> Known:
    """Records of the samples whose image is on disk, from the sealed files and from all journals."""
    return {split: _known_of(folder, split) for split in SPLITS}


def _known_of(folder: DatasetFolder, split: Split) -> dict[int, SampleRecord]:
    # In the order in which sealing moves them: whoever reads while another process seals finds each record once.
    journals = [path for path in folder.journals(split) if path != folder.journal_path(split)]
    records: list[SampleRecord] = []
    for path in (*journals, folder.journal_path(split), folder.metadata_path(split)):
        try:
            with suppress(FileNotFoundError):
                records += read_jsonl(path, SampleRecord.model_validate_json)
        except CorruptFileError as error:
            raise DatasetError(f"{error}; remove that line, and its image is rendered again") from error
    images = folder.images(split)
    # reversed: a journal is newer than the sealed file
    return {record.index: record for record in reversed(records) if record.file_name in images}


def missing(known: Known, wanted: Wanted) -> int:
    """How many of the samples asked for are not known."""
    return sum(index not in known[split] for split in SPLITS for index in range(wanted[split]))


def seal(folder: DatasetFolder, known: Known) -> None:
    """Write `metadata.jsonl`, remove the journals, and count the samples in the manifest: in this order.

    The caller holds the folder alone.
    """
    seals = {split: done for split in SPLITS if (done := _seal_split(folder, split, known[split])).n}
    remove_temporaries(folder.root)
    folder.write_manifest(folder.manifest.model_copy(update={"splits": seals}))


def _seal_split(folder: DatasetFolder, split: Split, known: dict[int, SampleRecord]) -> Seal:
    """Turn all samples without a gap into `metadata.jsonl`; what lies beyond a gap stays in the plain journal."""
    n = next(index for index in range(len(known) + 1) if index not in known)
    lines = "".join(known[index].model_dump_json() + "\n" for index in range(n))
    if n:
        write_atomic(folder.metadata_path(split), lines)
    beyond = "".join(known[index].model_dump_json() + "\n" for index in sorted(known) if index > n)
    if beyond:
        write_atomic(folder.journal_path(split), beyond)
    for journal in folder.journals(split):
        if not beyond or journal != folder.journal_path(split):
            journal.unlink()
    remove_temporaries(folder.split_folder(split))
    return Seal(n=n, metadata_sha256=sha256(lines.encode()))

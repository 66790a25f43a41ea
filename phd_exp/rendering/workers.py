"""Make sure that a data set is on disk: render what is missing, resume what was killed, then seal the folder.

Order of writing, so that a kill at any moment leaves a folder that the same call completes: the manifest (what
is being made); then for every image the image itself and its line in the journal; at the end `metadata.jsonl` out
of the journal, the journal's removal, and the manifest again, which now counts the samples.
"""

import math
import os
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager

from filelock import FileLock, Timeout

from phd_exp.records.dataset import SPLITS, DatasetError, DatasetFolder, Manifest, Seal, sha256
from phd_exp.records.files import CorruptFileError, open_journal, read_jsonl, remove_temporaries, write_atomic
from phd_exp.records.scenes import SampleRecord, Split
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.blender import renderer_version, require_bpy
from phd_exp.rendering.errors import RenderError, unwritable
from phd_exp.rendering.pool import render_all
from phd_exp.rendering.progress import announce, shown_progress
from phd_exp.rendering.sampling import GENERATOR_VERSION
from phd_exp.rendering.worker import Task

FEWEST_PER_WORKER = 8  # starting one more process costs about as much as rendering this many images
SECONDS_PER_IMAGE = 0.2  # one core, 224 px, 4 samples a pixel: for the announcement only

Known = dict[Split, dict[int, SampleRecord]]


def ensure_rendered(
    folder: DatasetFolder, spec: DatasetSpec, n_train: int, n_test: int, workers: int | None = None
) -> None:
    """Return when the first `n_train` and `n_test` samples are on disk, rendering those that are not.

    One process renders a folder at a time, others wait. What is rendered stays, whatever happens; the same
    call goes on from there, and the finished folder has the same bytes as one rendered without interruption.

    Args:
        workers: number of processes; by default one a core, fewer where there is little to do.

    Raises:
        DatasetError: the folder holds another data set, or a broken one.
        RenderError: bpy is missing, a worker died, the folder cannot be written.
    """
    if workers is not None and workers < 1:
        raise RenderError(f"workers={workers}: expected a number of processes, at least 1")
    if not any(folder.missing(spec, n_train, n_test).values()):
        return
    require_bpy()
    with _writing(folder), _alone_in(folder):
        # Another process may have finished the work while this one waited.
        if any(folder.missing(spec, n_train, n_test).values()):
            _render_missing(folder, spec, {"train": n_train, "test": n_test}, workers)


def _render_missing(
    folder: DatasetFolder, spec: DatasetSpec, wanted: dict[Split, int], workers: int | None
) -> None:
    manifest = _open_manifest(folder, spec)
    for split in SPLITS:
        folder.split_folder(split).mkdir(exist_ok=True)
        remove_temporaries(folder.split_folder(split))
    known: Known = {split: _finished_before(folder, split) for split in SPLITS}
    tasks = [
        Task(split=split, index=index)
        for split in SPLITS
        for index in range(wanted[split])
        if index not in known[split]
    ]
    if tasks:
        _render(folder, spec, tasks, workers or worker_count(len(tasks)), known)
    seals = {split: seal for split in SPLITS if (seal := _seal(folder, split, known[split])).n}
    folder.write_manifest(manifest.model_copy(update={"splits": seals}))


def _render(folder: DatasetFolder, spec: DatasetSpec, tasks: list[Task], workers: int, known: Known) -> None:
    """Render the tasks into `known`, each record journaled as soon as its image is on disk."""
    announce(_first_words(folder, spec, len(tasks), workers, resumed=any(known.values())))
    with ExitStack() as stack:
        journals = {split: stack.enter_context(open_journal(folder.journal_path(split))) for split in SPLITS}
        advance = stack.enter_context(shown_progress(len(tasks), f"rendering {spec.variant}"))
        for record in stack.enter_context(closing(render_all(folder, spec, tasks, workers))):
            journals[record.split].write(record.model_dump_json() + "\n")
            known[record.split][record.index] = record
            advance()


def _open_manifest(folder: DatasetFolder, spec: DatasetSpec) -> Manifest:
    """The folder's manifest, begun if there is none: before the first image, it says of which data set it is.

    Raises:
        DatasetError: the folder was made by another generator or another Blender: the rest would not match.
    """
    ours = Manifest(generator=GENERATOR_VERSION, renderer=renderer_version(), spec=spec, splits={})
    if not folder.manifest_path.exists():
        folder.write_manifest(ours)
        return ours
    found = folder.manifest
    for key in ("generator", "renderer"):
        theirs, mine = getattr(found, key), getattr(ours, key)
        if theirs != mine:
            raise DatasetError(
                f"{folder.root}: begun with {key} {theirs}, this is {mine}, and the rest would not match; "
                "move the folder away or choose another data.root"
            )
    return found


def _finished_before(folder: DatasetFolder, split: Split) -> dict[int, SampleRecord]:
    """Records of samples whose image is on disk, from the sealed file and from a killed run's journal."""
    records: list[SampleRecord] = []
    for path in (folder.metadata_path(split), folder.journal_path(split)):
        try:
            if path.exists():
                records += read_jsonl(path, SampleRecord.model_validate_json)
        except CorruptFileError as error:
            raise DatasetError(f"{error}; remove that line, and its image is rendered again") from error
    images = folder.images(split)
    return {record.index: record for record in records if record.file_name in images}


def _seal(folder: DatasetFolder, split: Split, known: dict[int, SampleRecord]) -> Seal:
    """Turn all samples without a gap into `metadata.jsonl`; what lies beyond a gap stays in the journal."""
    n = next(index for index in range(len(known) + 1) if index not in known)
    lines = "".join(known[index].model_dump_json() + "\n" for index in range(n))
    if n:
        write_atomic(folder.metadata_path(split), lines)
    beyond = "".join(known[index].model_dump_json() + "\n" for index in sorted(known) if index > n)
    if beyond:
        write_atomic(folder.journal_path(split), beyond)
    else:
        folder.journal_path(split).unlink(missing_ok=True)
    return Seal(n=n, metadata_sha256=sha256(lines.encode()))


def worker_count(tasks: int) -> int:
    """One process a core that this process may use, fewer for little work."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(cores, math.ceil(tasks / FEWEST_PER_WORKER)))


def _first_words(folder: DatasetFolder, spec: DatasetSpec, n: int, workers: int, *, resumed: bool) -> str:
    pixels, samples = (spec.sensor_size / 224) ** 2, spec.samples_per_pixel / 4
    minutes = n * SECONDS_PER_IMAGE * pixels * max(samples, 1.0) / workers / 60
    about = "less than a minute" if minutes < 1 else f"about {minutes:.0f} min"
    left = f"the remaining {n}" if resumed else f"{n}"
    return (
        f"rendering {left} images of '{spec.variant}' into {folder.root}, once: {about} with {workers} "
        f"process{'es' if workers > 1 else ''}; fewer with data.n_train=... data.n_test=...; "
        "stop at any time, the same command goes on"
    )


@contextmanager
def _alone_in(folder: DatasetFolder) -> Iterator[None]:
    """Hold the folder's lock, which the system drops when the process dies, however it dies."""
    folder.cache.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder.cache / "render.lock")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        announce(f"{folder.root}: another process is rendering here; waiting for it to finish")
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


@contextmanager
def _writing(folder: DatasetFolder) -> Iterator[None]:
    """An unwritable folder or a full disk is one line, not a stack of calls."""
    try:
        yield
    except OSError as error:
        raise unwritable(error, folder.root) from error

"""Make sure that a data set is on disk: render what is missing, resume what was interrupted, then seal the folder.

Order of writing, so that a kill at any moment leaves a folder that the same call completes: the manifest (what
is being made); then for every image the image itself and its line in the journal; at the end `metadata.jsonl` from
the journals, the journals' removal, and the manifest again, which now counts the samples (`sealing.py`).

Several processes, on one machine or many, may render shares (shards) of one folder at once. Locks, in its `.cache`:

    render.lock              held together by all shards, alone by an unsharded render and by the process that seals
    shard-<i>-of-<n>.lock    held alone by the process that renders this share
    begin.lock               held alone while the manifest is begun

A shard that has finished releases its locks and then tries to take `render.lock` alone. That fails while another
shard renders, which tries in its turn; so the last one to finish succeeds, and seals. If it is killed before, any
later render finds all work done and seals.
"""

import math
import time
from contextlib import ExitStack, closing

from phd_exp.records.dataset import SPLITS, DatasetFolder
from phd_exp.records.errors import RenderError, writing
from phd_exp.records.files import open_journal, remove_temporaries
from phd_exp.records.provenance import usable_cores
from phd_exp.records.shards import Shard
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.blender import require_bpy
from phd_exp.rendering.locks import held, held_if_free
from phd_exp.rendering.pool import render_all
from phd_exp.rendering.progress import announce, shown_progress
from phd_exp.rendering.sealing import Known, Wanted, begin, known_samples, missing, seal
from phd_exp.rendering.worker import Task

FEWEST_PER_WORKER = 8  # starting one more process costs about as much as rendering this many images
SECONDS_PER_OBJECT = 0.085  # one core, 224 px, 3 samples a pixel: for the announcement only


def ensure_rendered(
    folder: DatasetFolder,
    spec: DatasetSpec,
    n_train: int,
    n_test: int,
    workers: int | None = None,
    cores: int | None = None,
) -> None:
    """Return when the first `n_train` and `n_test` samples are on disk, rendering those that are not.

    One process, or the shards of one data set, render a folder at a time; others wait. Rendered images are kept,
    whatever happens: the same call resumes, and the finished folder has the same bytes as one rendered without
    interruption.

    Args:
        workers: number of processes; by default one a core, fewer where there is little to do.
        cores: how many there are to use; by default all that this process may use.

    Raises:
        DatasetError: the folder holds another data set, or a broken one.
        RenderError: bpy is missing, a worker died, the folder cannot be written.
    """
    _require_some(workers)
    if not any(folder.missing(spec, n_train, n_test).values()):
        return
    require_bpy()
    with writing(folder.root):
        folder.cache.mkdir(parents=True, exist_ok=True)
        occupied = f"{folder.root}: another process is rendering here; waiting for it to finish"
        with held(folder.render_lock, waiting=occupied):
            # Another process may have finished the work while this one waited.
            if not any(folder.missing(spec, n_train, n_test).values()):
                return
            begin(folder, spec)
            for split in SPLITS:
                remove_temporaries(folder.split_folder(split))
            known = known_samples(folder)
            render_missing(folder, spec, {"train": n_train, "test": n_test}, known, workers, cores=cores)
            seal(folder, known)


def render_shard(
    folder: DatasetFolder,
    spec: DatasetSpec,
    n_train: int,
    n_test: int,
    shard: Shard,
    workers: int | None = None,
    cores: int | None = None,
) -> bool:
    """Render what is missing of one share, and seal the folder if that was the last; whether all of it is there.

    Shares of different counts may overlap; work done by one is not done again by another that starts later.

    Raises:
        DatasetError: the folder holds another data set, or a broken one.
        RenderError: bpy is missing, a worker died, the folder cannot be written.
    """
    if not any(folder.missing(spec, n_train, n_test).values()):
        return True
    require_bpy()
    wanted: Wanted = {"train": n_train, "test": n_test}
    with writing(folder.root):
        folder.cache.mkdir(parents=True, exist_ok=True)
        with ExitStack() as stack:
            _enter(stack, folder, shard)
            with held(folder.cache / "begin.lock", waiting=f"{folder.root}: waiting for the manifest"):
                folder.missing(spec, n_train, n_test)  # refuses another data set, begun a moment ago
                begin(folder, spec)
            if not render_missing(folder, spec, wanted, known_samples(folder), workers, shard, cores):
                announce(f"{folder.root}: nothing left to render in shard {shard}")
        return _seal_if_last(folder, wanted, shard)


def _enter(stack: ExitStack, folder: DatasetFolder, shard: Shard) -> None:
    whole = f"{folder.root}: another process renders all of it; shard {shard} waits for it to finish"
    twin = f"{folder.root}: another process renders shard {shard}; waiting for it to finish"
    stack.enter_context(held(folder.render_lock, shared=True, waiting=whole))
    stack.enter_context(held(folder.cache / f"shard-{shard.slug}.lock", waiting=twin))


def _seal_if_last(folder: DatasetFolder, wanted: Wanted, shard: Shard) -> bool:
    with held_if_free(folder.render_lock) as alone:
        known = known_samples(folder)
        left = missing(known, wanted)
        if alone and not left:
            seal(folder, known)
            announce(f"{folder.root}: shard {shard} was the last; the data set is sealed")
            return True
    if left:
        announce(f"{folder.root}: shard {shard} is done; {left} samples of other shards are missing")
    else:
        announce(f"{folder.root}: shard {shard} is done; another process is still at work here, and seals")
    return False


def render_missing(
    folder: DatasetFolder,
    spec: DatasetSpec,
    wanted: Wanted,
    known: Known,
    workers: int | None,
    shard: Shard | None = None,
    cores: int | None = None,
) -> int:
    """Render the samples asked for, or those of a share, that are not yet in `known`, into it; returns how many.

    The caller holds the locks. Each record is journaled as soon as its image is on disk.
    """
    _require_some(workers)
    tasks = [
        Task(split=split, index=index)
        for split in SPLITS
        for index in range(wanted[split])
        if index not in known[split] and (shard is None or shard.holds(index))
    ]
    if not tasks:
        return 0
    workers = workers or worker_count(len(tasks), cores)
    title = spec.variant if shard is None else f"{spec.variant} {shard}"
    announce(_first_words(folder, spec, len(tasks), workers, resumed=any(known.values())))
    begun = time.monotonic()
    with ExitStack() as stack:
        journals = {
            split: stack.enter_context(open_journal(folder.journal_path(split, shard))) for split in SPLITS
        }
        advance = stack.enter_context(shown_progress(len(tasks), f"rendering {title}"))
        for record in stack.enter_context(closing(render_all(folder, spec, tasks, workers))):
            journals[record.split].write(record.model_dump_json() + "\n")
            known[record.split][record.index] = record
            advance()
    seconds = time.monotonic() - begun
    announce(f"rendered {len(tasks)} images in {seconds:.0f} s, {len(tasks) / seconds:.1f} a second")
    return len(tasks)


def _require_some(workers: int | None) -> None:
    if workers is not None and workers < 1:
        raise RenderError(f"workers={workers}: expected a number of processes, at least 1")


def worker_count(tasks: int, cores: int | None = None) -> int:
    """One process a core, by default each core that this process may use; fewer for little work."""
    return max(1, min(cores or usable_cores(), math.ceil(tasks / FEWEST_PER_WORKER)))


def _first_words(folder: DatasetFolder, spec: DatasetSpec, n: int, workers: int, *, resumed: bool) -> str:
    objects, pixels = 3 if spec.occluders else 1, (spec.sensor_size / 224) ** 2
    seconds = SECONDS_PER_OBJECT * objects * pixels * max(spec.samples_per_pixel / 3, 1.0)
    minutes = n * seconds / workers / 60
    about = "less than a minute" if minutes < 1 else f"about {minutes:.0f} min"
    left = f"the remaining {n}" if resumed else f"{n}"
    return (
        f"rendering {left} images of '{spec.variant}' into {folder.root}, once: {about} with {workers} "
        f"process{'es' if workers > 1 else ''}; fewer with data.n_train=... data.n_test=...; "
        "stop at any time, the same command goes on"
    )

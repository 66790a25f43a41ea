"""Make sure that a data set is on disk: render what is missing, resume what was interrupted, then seal the folder.

A kill at any moment leaves a folder that the same call completes. The order of writing is: the manifest, which names
the data set; for each image, the file and then its line in the journal; at the end `metadata.jsonl` from the
journals, the removal of the journals, and the manifest again, which now counts the samples (`sealing.py`).

Several processes, on one machine or many, may render shares (shards) of one folder at once. Locks, in its `.cache`:

    render.lock              shared by all shards; exclusive for an unsharded render and for the process that seals
    shard-<i>-of-<n>.lock    exclusive for the process that renders this shard
    begin.lock               exclusive while the manifest is written first

A finished shard releases its locks and then tries to take `render.lock` exclusively. That fails while another shard
renders, which tries in its turn, so that the last one to finish seals. If it is killed before, the next render
finds all work done and seals.
"""

import math
import time
from collections.abc import Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from itertools import islice
from multiprocessing.connection import Connection, wait

from phd_exp.records.dataset import SPLITS, DatasetFolder
from phd_exp.records.errors import RenderError, UserError, writing
from phd_exp.records.files import open_journal
from phd_exp.records.processes import Child, announce, duration, held, usable_cores
from phd_exp.records.scenes import SampleRecord, Split
from phd_exp.records.spec import DatasetSpec, Shard
from phd_exp.rendering.blender import require_bpy
from phd_exp.rendering.masks import ensure_drawn
from phd_exp.rendering.objects import surroundings_of
from phd_exp.rendering.progress import shown_progress
from phd_exp.rendering.sealing import Known, Wanted, begin, known_samples, missing, seal

Samples = Sequence[tuple[Split, int]]
"""Split and index of each sample."""
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # of each worker
TOGETHER = 128  # samples
FEWEST_PER_WORKER = 8  # starting one more process costs about as much as rendering this many images
WAITING = "waiting for it to finish"
FEWER = "preset=demo, or data.n_train=... data.n_test=..."


def ensure_rendered(
    folder: DatasetFolder,
    spec: DatasetSpec,
    n_train: int,
    n_test: int,
    workers: int | None = None,
    cores: int | None = None,
    shard: Shard | None = None,
    fewer: str = FEWER,
) -> bool:
    """Render those of the first `n_train` and `n_test` samples that are not on disk; returns whether all are there.

    The masks that training reads are drawn too. If that is impossible, a training that needs them says so.

    An unsharded call waits for other processes in the folder and leaves all samples there. Rendered images are kept,
    whatever happens: the same call resumes, and the finished folder has the same bytes as one rendered without
    interruption.

    Args:
        workers: number of processes; by default one per core, fewer if there is little to do.
        cores: number of cores to use; by default all that this process may use.
        shard: the share of the samples to render; the last shard to finish seals the folder. Shares of different
            counts may overlap: samples that another shard has rendered are not rendered again.
        fewer: overrides for fewer images, which a line names if the first forecast is long.

    Raises:
        DatasetError: the folder holds another data set, or a broken one.
        RenderError: bpy is missing, a worker died, the folder cannot be written.
    """
    if not any(folder.missing(spec, n_train, n_test).values()):
        with suppress(UserError):
            ensure_drawn(folder, spec, n_train)
        return True
    require_bpy()
    with writing(folder.root):
        folder.cache.mkdir(parents=True, exist_ok=True)
        return _render_share(folder, spec, {"train": n_train, "test": n_test}, workers, cores, shard, fewer)


def _render_share(
    folder: DatasetFolder,
    spec: DatasetSpec,
    wanted: Wanted,
    workers: int | None,
    cores: int | None,
    shard: Shard | None,
    fewer: str,
) -> bool:
    """Render the missing samples of a shard, None for all, and seal the folder if it is whole, which is returned."""
    with _locked(folder, shard):
        with held(folder.cache / "begin.lock", waiting=f"{folder.root}: waiting for the manifest"):
            # another process may have begun another data set, or finished this one, in the meantime
            if not any(folder.missing(spec, wanted["train"], wanted["test"]).values()):
                return True
            begin(folder, spec)
        known = known_samples(folder)
        samples = [sample for sample in missing(known, wanted) if shard is None or shard.holds(sample[1])]
        try:
            if samples:
                _render(folder, spec, samples, known, workers or worker_count(len(samples), cores), shard, fewer)
        except UserError:
            if not any(known.values()):  # the next command may have another specification
                folder.manifest_path.unlink(missing_ok=True)
            raise
        if shard is None:
            seal(folder, spec, known)
            return True
    if not samples:
        announce(f"{folder.root}: nothing left to render in shard {shard}")
    return _seal_if_last(folder, spec, wanted, shard)


@contextmanager
def _locked(folder: DatasetFolder, shard: Shard | None) -> Iterator[None]:
    if shard is None:
        with held(folder.render_lock, waiting=f"{folder.root}: another process is rendering here; {WAITING}"):
            yield
        return
    whole = f"{folder.root}: another process renders all of it; shard {shard} waits for it to finish"
    twin = f"{folder.root}: another process renders shard {shard}; {WAITING}"
    with (
        held(folder.render_lock, shared=True, waiting=whole),
        held(folder.cache / f"shard-{shard.slug}.lock", waiting=twin),
    ):
        yield


def _seal_if_last(folder: DatasetFolder, spec: DatasetSpec, wanted: Wanted, shard: Shard) -> bool:
    with held(folder.render_lock) as alone:
        known = known_samples(folder)
        left = len(missing(known, wanted))
        if alone and not left:
            seal(folder, spec, known)
            outcome = f"shard {shard} was the last; the data set is sealed"
        elif left:
            outcome = f"shard {shard} is done; {left} samples of other shards are missing"
        else:
            outcome = f"shard {shard} is done; another process is still at work here, and seals"
    announce(f"{folder.root}: {outcome}")
    return alone and not left


def _render(
    folder: DatasetFolder,
    spec: DatasetSpec,
    samples: Samples,
    known: Known,
    workers: int,
    shard: Shard | None,
    fewer: str,
) -> None:
    """Render samples and add them to `known`.

    The caller holds the locks. Each record is written to the journal as soon as its image is on disk.
    """
    announce(_first_words(folder, spec, len(samples), workers, resumed=any(known.values())))
    begun = time.monotonic()
    title = spec.variant if shard is None else f"{spec.variant} {shard}"
    with ExitStack() as stack:
        journals = {split: stack.enter_context(open_journal(folder.journal_path(split, shard))) for split in SPLITS}
        shown = shown_progress(
            len(samples), f"rendering {title}", min(workers, len(samples)), f"fewer images: {fewer}"
        )
        advance = stack.enter_context(shown)
        for record in stack.enter_context(closing(render_all(folder, spec, by_sky(spec, samples), workers))):
            journals[record.split].write(record.model_dump_json() + "\n")
            known[record.split][record.index] = record
            advance()
    seconds = time.monotonic() - begun
    announce(f"rendered {len(samples)} images in {duration(seconds)}, {len(samples) / seconds:.1f} a second")


def render_all(
    folder: DatasetFolder, spec: DatasetSpec, samples: Samples, workers: int
) -> Generator[SampleRecord, None, None]:
    """Render samples and yield each record as soon as its image is on disk.

    Each worker renders one sample at a time and gets the next after the consumer has processed its last record, so
    that a kill loses at most one sample per worker. If the consumer stops early or a worker fails, no further sample
    begins, the samples in progress are finished, and all processes end before the error is raised.

    Raises RenderError if a worker failed or died.
    """
    log, todo = folder.cache / "render.log", iter(samples)
    busy: dict[Connection, Child] = {}
    with ExitStack() as stack:
        for sample in islice(todo, workers):
            child = stack.enter_context(Child("phd_exp.rendering.worker", ONE_THREAD, log))
            child.send((folder, spec))
            child.send(sample)
            busy[child.connection] = child
        while busy:
            for connection in wait(list(busy)):
                assert isinstance(connection, Connection)
                try:
                    record = busy[connection].receive()
                except EOFError as death:
                    raise RenderError(
                        f"a render worker: {death}; finished images are kept, and the same command resumes "
                        f"(its last words: {log})"
                    ) from None
                yield record
                if (following := next(todo, None)) is None:
                    del busy[connection]
                else:
                    busy[connection].send(following)


def by_sky(spec: DatasetSpec, samples: Samples) -> Samples:
    """The samples in another order: of each TOGETHER in succession, those with the same sky follow each other.

    A worker needs longer to load another sky than for the rest of the scene.
    """
    if spec.mesh is None or spec.backdrops is None:
        return samples

    def sky(sample: tuple[Split, int]) -> str:
        split, index = sample
        return surroundings_of(spec, split, index // spec.views)[0].file or ""

    parts = (samples[first : first + TOGETHER] for first in range(0, len(samples), TOGETHER))
    return [sample for part in parts for sample in sorted(part, key=sky)]


def worker_count(samples: int, cores: int | None = None) -> int:
    """Default number of processes: one per core that may be used, fewer for little work."""
    return max(1, min(cores or usable_cores(), math.ceil(samples / FEWEST_PER_WORKER)))


def _first_words(folder: DatasetFolder, spec: DatasetSpec, n: int, workers: int, *, resumed: bool) -> str:
    left = f"the remaining {n}" if resumed else f"{n}"
    return (
        f"rendering {left} images of '{spec.variant}' into {folder.root}, once, with {workers} "
        f"process{'es' if workers > 1 else ''}; the time left follows the first images; "
        "stop at any time, the same command resumes"
    )

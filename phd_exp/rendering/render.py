"""Make sure that a data set is on disk: render what is missing, then seal the folder (`sealing.py`).

A sample is a function of the specification, the split and the index alone. So any number of processes, on one machine
or many, may run the same command on a shared folder: each makes the samples that no other has made or is making, and
one of them seals. A kill loses the images in progress; the same command resumes. Locks, in `.cache`: a byte of
`<split>.lock` for each sample while it is made, and `render.lock` while the manifest is written.
"""

import math
import os
import sys
import time
from collections.abc import Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from contextlib import closing, contextmanager, suppress
from itertools import islice
from multiprocessing import get_context
from types import ModuleType

from phd_exp.records.dataset import SPLITS, DatasetFolder
from phd_exp.records.errors import RenderError, UserError, writing
from phd_exp.records.processes import announce, duration, usable_cores
from phd_exp.records.spec import DatasetSpec, Shard
from phd_exp.rendering.blender import require_bpy
from phd_exp.rendering.masks import ensure_drawn
from phd_exp.rendering.objects import surroundings_of
from phd_exp.rendering.progress import shown_progress
from phd_exp.rendering.sealing import Sample, begin, seal, side_files, unmade
from phd_exp.rendering.worker import begin_worker, make_here

ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # of each worker
TOGETHER = 128  # samples
AHEAD = 2  # samples that wait or are in progress, for each process
FEWEST_PER_WORKER = 8  # starting one more process costs about as much as rendering this many images
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

    The masks that training reads are drawn too. If that is impossible, a training that needs them says so. Rendered
    images are kept, whatever happens. The finished folder has the same bytes as one rendered without interruption.

    Args:
        workers: number of processes; by default one per core, fewer if there is little to do.
        cores: number of cores to use; by default all that this process may use.
        shard: the share of the samples to render; without one, all samples are there at the end.
        fewer: overrides for fewer images, which a line names if the first forecast is long.

    Raises:
        DatasetError: the folder holds another data set, or a broken one.
        RenderError: bpy is missing, a worker died, the folder cannot be written.
    """
    wanted = (n_train, n_test)
    if any(folder.missing(spec, *wanted).values()):
        require_bpy()
        with writing(folder.root):
            folder.cache.mkdir(parents=True, exist_ok=True)
            begin(folder, spec)
            left = unmade(folder, spec, *wanted)
            share = [sample for sample in left if shard is None or shard.holds(sample[1])]
            if share:
                is_resumed = len(left) < sum(wanted)
                n_workers = workers or worker_count(len(share), cores)
                _render(folder, spec, share, n_workers, fewer, is_resumed=is_resumed)
            if not seal(folder, spec, *wanted):
                return False
    with suppress(UserError):
        ensure_drawn(folder, spec, n_train)
    return True


def _render(
    folder: DatasetFolder, spec: DatasetSpec, samples: Sequence[Sample], workers: int, fewer: str, *, is_resumed: bool
) -> None:
    """Make samples, and wait for those that other processes make."""
    n, many = len(samples), "es" if workers > 1 else ""
    announce(
        f"rendering {'the remaining ' * is_resumed}{n} images of '{spec.variant}' into {folder.root}, once, with "
        f"{workers} process{many}; the time left follows the first images; stop at any time, the same command resumes"
    )
    begun = time.monotonic()
    try:
        with shown_progress(n, f"rendering {spec.variant}", f"fewer images: {fewer}") as advance:
            for waits in (False, True):
                elsewhere = []
                with closing(render_all(folder, spec, by_sky(spec, samples), workers, waits=waits)) as made:
                    for sample, is_there in made:
                        advance() if is_there else elsewhere.append(sample)
                samples = elsewhere
                if samples:
                    announce(f"{folder.root}: waiting for {len(samples)} images that other processes render")
    except UserError:
        if not (folder.manifest.splits or any(side_files(folder, split) for split in SPLITS)):
            # the next command may have another specification
            folder.manifest_path.unlink(missing_ok=True)
        raise
    seconds = time.monotonic() - begun
    announce(f"rendered {n} images in {duration(seconds)}, {n / seconds:.1f} a second")


def render_all(
    folder: DatasetFolder, spec: DatasetSpec, samples: Sequence[Sample], workers: int, *, waits: bool = False
) -> Generator[tuple[Sample, bool], None, None]:
    """Make samples in processes and yield each with whether it is on disk, or another process makes it.

    `waits`: until the other process has made it. If the consumer stops early or a process fails, no further sample
    begins, the samples in progress are finished, and all processes end before the error is raised.

    Raises RenderError if a process failed or died.
    """
    log, todo = folder.cache / "render.log", iter(samples)
    workers = min(workers, len(samples)) or 1
    pool = ProcessPoolExecutor(workers, get_context("spawn"), begin_worker, (log,))
    busy: dict[Future[bool], Sample] = {}

    def submit(several: Iterable[Sample]) -> None:
        busy.update({pool.submit(make_here, folder, spec, sample, waits=waits): sample for sample in several})

    try:
        with _clean_start():
            submit(islice(todo, AHEAD * workers))
        while busy:
            for future in wait(busy, return_when=FIRST_COMPLETED).done:
                yield busy.pop(future), future.result()
                submit(islice(todo, 1))
    except BrokenExecutor:
        raise RenderError(
            "a render worker was killed, or memory ran out; finished images are kept, and the same command resumes "
            f"(its last words: {log})"
        ) from None
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def _clean_start() -> Iterator[None]:
    """Processes that begin here use one thread each, and import nothing of the caller's main module.

    A script without `if __name__ == "__main__"` would otherwise run again in each of them.
    """
    main, before = sys.modules["__main__"], {name: os.environ.get(name) for name in ONE_THREAD}
    sys.modules["__main__"] = ModuleType("__main__")
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        sys.modules["__main__"] = main
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def by_sky(spec: DatasetSpec, samples: Sequence[Sample]) -> Sequence[Sample]:
    """The samples in another order: of each TOGETHER in succession, those with the same sky follow each other.

    A worker needs longer to load another sky than for the rest of the scene.
    """
    if spec.mesh is None or spec.backdrops is None:
        return samples

    def sky(sample: Sample) -> str:
        split, index = sample
        return surroundings_of(spec, split, index // spec.views)[0].file or ""

    parts = (samples[first : first + TOGETHER] for first in range(0, len(samples), TOGETHER))
    return [sample for part in parts for sample in sorted(part, key=sky)]


def worker_count(samples: int, cores: int | None = None) -> int:
    """Default number of processes: one per core that may be used, fewer for little work."""
    return max(1, min(cores or usable_cores(), math.ceil(samples / FEWEST_PER_WORKER)))

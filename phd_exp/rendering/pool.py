"""Several worker processes (`worker.py`) render the samples of one data set."""

from collections.abc import Generator, Sequence
from contextlib import ExitStack
from itertools import islice
from multiprocessing.connection import Connection, wait
from pathlib import Path

from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.errors import RenderError, UserError
from phd_exp.records.processes import Child
from phd_exp.records.scenes import SampleRecord, Split
from phd_exp.records.spec import DatasetSpec

ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def render_all(
    folder: DatasetFolder, spec: DatasetSpec, samples: Sequence[tuple[Split, int]], workers: int
) -> Generator[SampleRecord, None, None]:
    """Render samples, given by split and index, and yield each record as soon as its image is on disk.

    Each worker renders one sample at a time and gets the next after the consumer has processed its last record, so
    that a kill loses at most one sample per worker. If the consumer stops early or a worker fails, no further sample
    begins, the samples in progress are finished, and all processes end before the error is raised.

    Raises:
        RenderError: a worker failed or died.
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
                yield _answer(busy[connection], log)
                if (following := next(todo, None)) is None:
                    del busy[connection]
                else:
                    busy[connection].send(following)


def _answer(child: Child, log: Path) -> SampleRecord:
    try:
        answer: SampleRecord | UserError = child.receive()
    except EOFError as death:
        raise RenderError(
            f"a render worker: {death}; finished images are kept, and the same command resumes "
            f"(its last words: {log})"
        ) from None
    if isinstance(answer, UserError):
        raise answer
    return answer

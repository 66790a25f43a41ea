"""`python -m phd_exp.rendering.worker FD`: a process that makes the samples that it receives."""

import fcntl
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from multiprocessing.connection import Connection

from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.errors import RenderError, UserError, writing
from phd_exp.records.files import write_atomic
from phd_exp.records.processes import one_core, parent
from phd_exp.records.scenes import SampleRecord, Split
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.blender import Renderer
from phd_exp.rendering.samples import fast_settings, make_sample
from phd_exp.rendering.sealing import side_file

Paint = Callable[[Split, int], tuple[bytes, SampleRecord]]


def serve(connection: Connection) -> None:
    """Receive a data set, then one sample after another; answer each as `make` does, or with a UserError.

    Raises EOFError or BrokenPipeError when the parent is gone.
    """
    folder, spec = connection.recv()
    renderer: Renderer | None = None  # built for the first sample, so that its errors are answers

    def paint(split: Split, index: int) -> tuple[bytes, SampleRecord]:
        nonlocal renderer
        # Blender and its denoiser would start threads that take cores from the other workers
        with one_core() if renderer is None else nullcontext():
            renderer = renderer or Renderer(fast_settings(spec), spec)
            return make_sample(renderer, spec, split, index)

    while True:
        split, index, waits = connection.recv()
        answer: bool | UserError
        try:
            with writing(folder.root):
                answer = make(folder, spec, split, index, paint, waits=waits)
        except UserError as error:
            answer = error
        except Exception as error:
            traceback.print_exc()
            answer = RenderError(f"sample {index} of {split}: {type(error).__name__}: {error}")
        connection.send(answer)


def make(folder: DatasetFolder, spec: DatasetSpec, split: Split, index: int, paint: Paint, *, waits: bool) -> bool:
    """Write a sample's image and then its side file, unless they are there; returns whether they are.

    A sample that another process is making is not there, unless this one `waits` for it.
    """
    with claimed(folder, split, index, waits=waits) as is_mine:
        if is_mine and not _is_there(folder, spec, split, index):
            image, record = paint(split, index)
            write_atomic(folder.image_path(split, index, spec.image_format), image)
            write_atomic(side_file(folder, split, index), record.model_dump_json() + "\n")
        return is_mine


@contextmanager
def claimed(folder: DatasetFolder, split: Split, index: int, *, waits: bool) -> Iterator[bool]:
    """Hold the right to make a sample: the lock on one byte of a file, which the system releases if the holder dies.

    Yields False if another process holds it, unless this one waits.
    """
    with open(folder.cache / f"{split}.lock", "ab") as stream:
        try:
            fcntl.lockf(stream, fcntl.LOCK_EX | (0 if waits else fcntl.LOCK_NB), 1, index)
        except (BlockingIOError, PermissionError):  # which of them depends on the system
            yield False
            return
        yield True


def _is_there(folder: DatasetFolder, spec: DatasetSpec, split: Split, index: int) -> bool:
    """Whether another process has made a sample, and perhaps sealed it, in the meantime."""
    image, side = folder.image_path(split, index, spec.image_format), side_file(folder, split, index)
    return image.exists() and (side.exists() or index < folder.manifest.count(split))


if __name__ == "__main__":
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        serve(parent())

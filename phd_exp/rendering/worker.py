"""What a process of the pool does: it makes samples that no other process makes."""

import fcntl
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from multiprocessing import parent_process
from pathlib import Path

from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.errors import RenderError, UserError, writing
from phd_exp.records.files import write_atomic
from phd_exp.records.processes import one_core
from phd_exp.records.scenes import SampleRecord, Split
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.blender import Renderer
from phd_exp.rendering.samples import fast_settings, make_sample
from phd_exp.rendering.sealing import Sample, side_file

Paint = Callable[[DatasetSpec, Split, int], tuple[bytes, SampleRecord]]
_renderer: list[Renderer] = []  # that of this process, as soon as there is a first sample


def begin_worker(log: Path) -> None:
    """Prepare a process: its output goes to a file, its parent handles Ctrl-C, and it ends with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Blender in the parent added folders that hold another package of its name
    sys.path[:] = [folder for folder in sys.path if f"{os.sep}bpy{os.sep}" not in folder]
    with open(log, "ab") as stream:
        for descriptor in (1, 2):
            os.dup2(stream.fileno(), descriptor)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def make_here(folder: DatasetFolder, spec: DatasetSpec, sample: Sample, *, waits: bool) -> bool:
    """`make` a sample by this process's renderer. Raises RenderError, whatever goes wrong."""
    try:
        with writing(folder.root):
            return make(folder, spec, sample, _paint, waits=waits)
    except UserError:
        raise
    except Exception as error:
        traceback.print_exc()
        raise RenderError(f"sample {sample[1]} of {sample[0]}: {type(error).__name__}: {error}") from None


def _paint(spec: DatasetSpec, split: Split, index: int) -> tuple[bytes, SampleRecord]:
    # Blender and its denoiser would start threads that take cores from the other processes
    with nullcontext() if _renderer else one_core():
        if not _renderer:
            _renderer.append(Renderer(fast_settings(spec), spec))
        return make_sample(_renderer[0], spec, split, index)


def make(folder: DatasetFolder, spec: DatasetSpec, sample: Sample, paint: Paint, *, waits: bool) -> bool:
    """Write a sample's image and then its side file, unless they are there; returns whether they are.

    A sample that another process is making is not there, unless this one `waits` for it.
    """
    split, index = sample
    with _claimed(folder, split, index, waits=waits) as is_mine:
        if is_mine and not _is_there(folder, spec, split, index):
            image, record = paint(spec, split, index)
            write_atomic(folder.image_path(split, index, spec.image_format), image)
            write_atomic(side_file(folder, split, index), record.model_dump_json() + "\n")
        return is_mine


@contextmanager
def _claimed(folder: DatasetFolder, split: Split, index: int, *, waits: bool) -> Iterator[bool]:
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

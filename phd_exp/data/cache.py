"""Images decoded once: a memory-mapped uint8 array beside the data set, so that no epoch decodes a file again."""

import json
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rich.console import Console
from rich.progress import track

from phd_exp.records.errors import DatasetError
from phd_exp.records.files import read_plain, require_plain, write_atomic
from phd_exp.records.parsing import parse_json
from phd_exp.records.processes import held

DECODERS = 4
LARGEST_AT_ONCE = 1 << 26
"""Pixels of the images that are decoded at the same time."""

Job = TypeVar("Job")
Fill = Callable[[np.ndarray, Job], None]
"""Decodes what one job asks for into rows of the array that no other job writes."""


class CacheError(DatasetError):
    """There is no place for decoded images."""


def cached(
    file: Path,
    key: dict[str, Any],
    shape: tuple[int, ...],
    jobs: Sequence[Job],
    fill: Fill,
    words: str,
    largest: int = 1,
) -> np.ndarray:
    """The array of this key, memory-mapped from the file; filled first unless the file holds precisely that.

    `largest` is the number of pixels of the largest image, which bounds how many are decoded at the same time.

    Raises CacheError where the file's folder cannot be written, and whatever `fill` raises.
    """
    key_file = file.with_suffix(".json")
    with _alone_in(file.parent):  # the runs of a parallel sweep all come here first
        if (kept := _kept(file, key_file, key, shape)) is None:
            unfinished = file.with_suffix(".unfinished")
            unfinished.unlink(
                missing_ok=True
            )  # a link there, of somebody else, would have its target written
            array = np.lib.format.open_memmap(unfinished, mode="w+", dtype=np.uint8, shape=shape)
            fill_all(array, jobs, fill, words, largest)
            array.flush()
            unfinished.replace(file)
            write_atomic(key_file, json.dumps(key) + "\n")
            kept = _mapped(file)
    return kept


def fill_all(array: np.ndarray, jobs: Sequence[Job], fill: Fill, words: str, largest: int = 1) -> None:
    """Do all jobs in several threads, with a progress bar on a terminal; the larger the images, the fewer threads."""
    with ThreadPoolExecutor(max(1, min(DECODERS, LARGEST_AT_ONCE // largest))) as pool:
        done = pool.map(lambda job: fill(array, job), jobs)
        console = Console(stderr=True)
        quiet = not console.is_terminal
        for _ in track(done, words, len(jobs), console=console, transient=True, disable=quiet):
            pass


@contextmanager
def _alone_in(cache: Path) -> Iterator[None]:
    """One process at a time decodes; the others wait and find the work done."""
    try:
        cache.mkdir(parents=True, exist_ok=True)
        with held(
            cache / "decoding.lock", waiting=f"{cache}: another process decodes images; waiting for it"
        ):
            yield
    except OSError as error:
        raise CacheError(f"{cache}: decoded images cannot be kept here ({error.strerror})") from None


def _kept(file: Path, key_file: Path, key: dict[str, Any], shape: tuple[int, ...]) -> np.ndarray | None:
    """The array that is there; None where it is none of this key and shape, so that it is made again."""
    try:
        if parse_json(read_plain(key_file).decode()) != key:
            return None
        require_plain(file)
        array = _mapped(file)
    except (OSError, ValueError):
        return None
    return array if array.shape == shape and array.dtype == np.uint8 else None


def _mapped(file: Path) -> np.ndarray:
    # copy-on-write: torch wants a writable array, and nothing may write into this file
    array: np.ndarray = np.load(file, mmap_mode="c", allow_pickle=False)
    return array

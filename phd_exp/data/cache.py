"""A cache of decoded images: a memory-mapped uint8 array next to the data set."""

import json
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from phd_exp.records.dataset import mapped
from phd_exp.records.files import read_plain, write_atomic
from phd_exp.records.parsing import parse_json
from phd_exp.records.processes import announce, held

DECODERS = 4
LARGEST_AT_ONCE = 1 << 26  # pixels decoded at the same time

Job = TypeVar("Job")
Fill = Callable[[np.ndarray, Job], None]
"""Decodes one job into its own rows of the array."""


def cached(
    file: Path,
    key: dict[str, Any],
    shape: tuple[int, ...],
    jobs: Sequence[Job],
    fill: Fill,
    words: str,
    largest: int = 1,
) -> np.ndarray:
    """The array of a key, memory-mapped from a file; filled first unless the file already holds it.

    Args:
        file: the array; the key is stored next to it.
        key: everything that the pixels depend on.
        shape: of the array.
        jobs: arguments of the calls to `fill`, which run in several threads.
        fill: decodes one job into the array.
        words: description of the progress bar, which a terminal shows.
        largest: pixels of the largest image; bounds the number of threads.

    If the folder cannot be written, the images are decoded into memory, and a line says so.
    """

    def fill_all(array: np.ndarray) -> None:
        from rich.console import Console  # imported slowly, and most arrays are there
        from rich.progress import track

        console = Console(stderr=True)
        with ThreadPoolExecutor(max(1, min(DECODERS, LARGEST_AT_ONCE // largest))) as pool:
            done = pool.map(partial(fill, array), jobs)
            for _ in track(done, words, len(jobs), console=console, transient=True, disable=not console.is_terminal):
                pass

    key_file, unfinished = file.with_suffix(".json"), file.with_suffix(".unfinished")
    waiting = f"{file.parent}: another process decodes images; waiting for it"
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with held(file.parent / "decoding.lock", waiting=waiting):  # concurrent runs of a sweep decode once
            with suppress(OSError, ValueError):  # missing, broken, or of another key or shape
                if parse_json(read_plain(key_file).decode()) == key:
                    return mapped(file, shape)
            unfinished.unlink(missing_ok=True)  # if it is a link, writing would overwrite its target
            array = np.lib.format.open_memmap(unfinished, mode="w+", dtype=np.uint8, shape=shape)
            with open(unfinished, "r+b") as stream:  # a mapped page without room on the disk would kill the process
                os.posix_fallocate(stream.fileno(), 0, unfinished.stat().st_size)
            fill_all(array)
            array.flush()
            unfinished.replace(file)
            write_atomic(key_file, json.dumps(key) + "\n")
            return mapped(file, shape)
    except OSError as error:
        with suppress(OSError):
            unfinished.unlink()
        why = f"{file.parent}: decoded images cannot be kept here ({error.strerror})"
        announce(f"{why}; they are decoded into memory, each run anew")
        array = np.empty(shape, dtype=np.uint8)
        fill_all(array)
        return array

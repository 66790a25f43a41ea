"""Images decoded once: a memory-mapped uint8 array beside the data set, so that no epoch decodes a file again."""

import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from filelock import FileLock
from PIL import Image, UnidentifiedImageError
from rich.console import Console
from rich.progress import track

from phd_exp.records.dataset import DatasetError, DatasetFolder, sha256
from phd_exp.records.files import write_atomic
from phd_exp.records.scenes import SampleRecord, Split

DECODERS = 4
CACHE_LAYOUT = 1
"""Raised whenever the meaning of a cached array changes, so that no old one is taken for a new one."""


def cached_images(
    folder: DatasetFolder, split: Split, records: Sequence[SampleRecord], image_size: int
) -> np.ndarray:
    """The images of the records as a memory-mapped array (n, image_size, image_size, 3), uint8.

    Decodes them if no array of precisely these images is there yet. Down-sampling averages areas, so that f and
    S scale by the same factor as the image's side.

    Raises DatasetError for an image that is missing, is damaged, or cannot be decoded.
    """
    array_file = folder.cache / f"{split}-{len(records)}x{image_size}.npy"
    key_file = array_file.with_suffix(".json")
    key = {"layout": CACHE_LAYOUT, "images": _digest(records)}
    with _alone_in(folder.cache):  # the runs of a parallel sweep all come here first
        if not (array_file.exists() and _read_key(key_file) == key):
            _decode_all(folder, split, records, image_size, array_file)
            write_atomic(key_file, json.dumps(key) + "\n")
    # copy-on-write: torch wants a writable array, and nothing may write into this file
    return np.load(array_file, mmap_mode="c")


def decode(file: Path, checksum: str, image_size: int) -> np.ndarray:
    """One image as (image_size, image_size, 3), uint8. Raises DatasetError where the file is not as recorded."""
    advice = "delete the file and run `python -m phd_exp render` to make it again"
    try:
        content = file.read_bytes()
    except OSError as error:
        raise DatasetError(f"{file}: cannot be read ({error.strerror}); {advice}") from None
    if sha256(content) != checksum:
        raise DatasetError(f"{file}: its checksum is not the recorded one; {advice}")
    try:
        with Image.open(file) as image:
            return _resized(image, image_size)
    except (OSError, UnidentifiedImageError) as error:
        raise DatasetError(f"{file}: cannot be decoded ({error}); {advice}") from None


@contextmanager
def _alone_in(cache: Path) -> Iterator[None]:
    """One process at a time decodes; the others wait and find the work done."""
    try:
        cache.mkdir(parents=True, exist_ok=True)
        with FileLock(cache / "decoding.lock"):
            yield
    except OSError as error:
        raise DatasetError(f"{cache}: decoded images cannot be kept here ({error.strerror})") from None


def _resized(image: Image.Image, image_size: int) -> np.ndarray:
    colour = image.convert("RGB")
    if colour.size != (image_size, image_size):
        colour = colour.resize((image_size, image_size), Image.Resampling.BOX)
    return np.asarray(colour)


def _decode_all(
    folder: DatasetFolder, split: Split, records: Sequence[SampleRecord], image_size: int, array_file: Path
) -> None:
    unfinished = array_file.with_suffix(".unfinished")
    shape = (len(records), image_size, image_size, 3)
    array = np.lib.format.open_memmap(unfinished, mode="w+", dtype=np.uint8, shape=shape)

    def fill(row: int) -> None:
        record = records[row]
        array[row] = decode(folder.split_folder(split) / record.file_name, record.sha256, image_size)

    with ThreadPoolExecutor(DECODERS) as pool:
        jobs = pool.map(fill, range(len(records)))
        words, console = f"decoding {split} images once", Console(stderr=True)
        quiet = not console.is_terminal
        for _ in track(jobs, words, len(records), console=console, transient=True, disable=quiet):
            pass
    array.flush()
    unfinished.replace(array_file)


def _digest(records: Sequence[SampleRecord]) -> str:
    return sha256("".join(record.sha256 for record in records).encode())


def _read_key(key_file: Path) -> object:
    """What the array beside it was made of; None where that is unknown, so that it is made again."""
    try:
        return json.loads(key_file.read_text())
    except (OSError, ValueError):
        return None

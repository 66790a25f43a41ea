"""The folder of one data set: its files, their contents, and whether it holds what was asked for.

    renders/<variant>/
        manifest.json                 what made the folder, and how many samples are finished
        <split>/000123.png            images (.webp, .jpg)
        <split>/metadata.jsonl        one line per sample, sorted by index
        masks.npy, clearings.npy      where training images show the object, and no object (`rendering/masks.py`)
        masks.json, clearings.json    the version of the drawing of each
        .cache/                       data that programs derive from the images; while rendering, a record for each

`SampleRecord` describes a line. The arrays follow from the lines; the manifest does not count them.
"""

import hashlib
import sys
from mmap import MAP_PRIVATE, mmap
from pathlib import Path
from typing import Annotated, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from phd_exp.records.choices import first_difference
from phd_exp.records.errors import DatasetError, reading
from phd_exp.records.files import read_jsonl, read_plain, require_plain, write_atomic
from phd_exp.records.parsing import Record, parse_json
from phd_exp.records.scenes import SampleRecord, Split
from phd_exp.records.spec import DatasetSpec, ImageFormat

SPLITS: tuple[Split, ...] = get_args(Split)
NO_RESERVE = 0x4000 if sys.platform == "linux" else 0  # MAP_NORESERVE, which Python 3.11 does not name
SUFFIXES: dict[ImageFormat, str] = {"png": ".png", "webp": ".webp", "jpeg": ".jpg"}
CELLS = 28  # cells along each side of a mask: 8 x 8 pixels of a render of 224
DRAWING = {"drawing": 1}  # version of masks and clearings, recorded with each; raise it if they are drawn otherwise


class Seal(Record):
    """Number of finished samples of a split, and the checksum of its `metadata.jsonl`."""

    n: Annotated[int, Field(ge=0)]
    metadata_sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class Manifest(Record):
    """What made a data set: `generator` is the version of the sampling code, `renderer` the path tracer."""

    generator: int
    renderer: str
    spec: DatasetSpec
    splits: dict[Split, Seal]

    def count(self, split: Split) -> int:
        """Number of finished samples of a split."""
        return self.splits[split].n if split in self.splits else 0


class DatasetFolder:
    """One data set on disk; `root` is its folder, `renders/<variant>`.

    Examples:
        >>> folder = DatasetFolder(Path("/data/renders/scale"))
        >>> folder.image_path("train", 7).relative_to(folder.root).as_posix()
        'train/000007.png'
    """

    def __init__(self, root: Path) -> None:
        self.root = Path(root).absolute()
        self.manifest_path = self.root / "manifest.json"
        self.cache = self.root / ".cache"  # hidden from loaders that search for images
        self.render_lock = self.cache / "render.lock"

    def split_folder(self, split: Split) -> Path:
        """The folder of the images of a split and of their metadata."""
        return self.root / split

    def metadata_path(self, split: Split) -> Path:
        """The finished samples of a split."""
        return self.root / split / "metadata.jsonl"

    def image_path(self, split: Split, index: int, image_format: ImageFormat = "png") -> Path:
        """The image of a sample."""
        return self.root / split / image_name(index, image_format)

    def images(self, split: Split) -> set[str]:
        """Names of the images on disk."""
        return {entry.name for entry in self.split_folder(split).glob("[0-9]*.*")}

    @property
    def manifest(self) -> Manifest:
        """The manifest. Raises DatasetError if there is none, or if it cannot be read."""
        if not self.manifest_path.exists():
            raise DatasetError(f"{self.root}: no data set here (manifest.json is missing); render it first")
        remedy = "restore it, or move the folder away and render anew"
        with reading(self.manifest_path, remedy, what="not a readable manifest"):
            return Manifest.model_validate_json(read_plain(self.manifest_path))

    def write_manifest(self, manifest: Manifest) -> None:
        """Replace the manifest. Raises OSError if the folder cannot be written."""
        write_atomic(self.manifest_path, manifest.model_dump_json(indent=2) + "\n")

    def records(self, split: Split, n: int | None = None) -> list[SampleRecord]:
        """The first `n` finished samples of a split, all by default, in the order of their indices.

        Raises:
            DatasetError: fewer than `n` are finished, or there is no data set.
            CorruptFileError: a line is not a record.
        """
        path, finished = self.metadata_path(split), self.manifest.count(split)
        wanted = finished if n is None else n
        if wanted > finished:
            raise DatasetError(
                f"{self.split_folder(split)}: {wanted} samples asked for, {finished} found; render the rest"
            )
        if wanted == 0:
            return []
        if not path.exists():
            raise DatasetError(f"{path}: missing though the manifest counts {finished} samples; render again")
        records = read_jsonl(path, SampleRecord.model_validate_json, limit=wanted, sealed=True)
        if [record.index for record in records] != list(range(wanted)):
            raise DatasetError(f"{path}: expected samples 0 to {wanted - 1} in order; restore it, or move the folder")
        return records

    def drawn(self, name: str, n: int) -> NDArray[np.uint8]:
        """Rows of the first `n` training images in `masks.npy` (n, CELLS, CELLS) or `clearings.npy` (n, S, S / 8).

        They are `mapped`. Raises DatasetError if they are not there, or were drawn by another version.
        """
        S = self.manifest.spec.sensor_size
        row = (CELLS, CELLS) if name == "masks.npy" else (S, -(-S // 8))
        file = self.root / name
        with reading(file, "write it by `python -m phd_exp render data=...` where the folder may be written"):
            version = file.with_suffix(".json")
            if not version.exists() or parse_json(read_plain(version).decode()) != DRAWING:
                raise ValueError("drawn by another version of the program")
            return mapped(file, (n, *row))

    def missing(self, spec: DatasetSpec, n_train: int, n_test: int) -> dict[Split, list[int]]:
        """Indices of the wanted samples that are not finished, or whose image or line has gone, by split.

        Raises DatasetError if the folder holds a data set with another specification.
        """
        wanted: dict[Split, int] = {"train": n_train, "test": n_test}
        manifest = self.require(spec) if self.manifest_path.exists() else None
        missing = {}
        for split, n in wanted.items():
            there = self.images(split) if self.metadata_path(split).exists() else set()
            finished = manifest.count(split) if manifest else 0
            missing[split] = [i for i in range(n) if i >= finished or image_name(i, spec.image_format) not in there]
        return missing

    def require(self, spec: DatasetSpec) -> Manifest:
        """The manifest, if the folder holds a data set with this specification.

        Raises DatasetError if it holds none, or one with another specification; names the first key that differs.
        """
        manifest = self.manifest
        if difference := first_difference(dict(manifest.spec), dict(spec)):
            raise DatasetError(
                f"{self.root}: holds a data set with {difference} is asked for; move the folder away, or choose "
                "another data.variant (a new name) or data.root"
            )
        return manifest


def mapped(file: Path, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """The first rows of an array on disk, which together have this shape, mapped into memory.

    The array is writable, as torch requires; the file does not change. It may be larger than the memory. Raises
    OSError or ValueError if the file does not hold such rows.
    """
    require_plain(file)
    array: np.memmap = np.lib.format.open_memmap(file, mode="r")
    if array.dtype != np.uint8 or array.shape[1:] != shape[1:] or len(array) < shape[0]:
        raise ValueError(f"holds {array.dtype} {array.shape}; expected uint8 {shape}")
    with open(file, "rb") as stream:  # NumPy's copy-on-write mode reserves memory for the whole file
        pages = mmap(stream.fileno(), 0, flags=MAP_PRIVATE | NO_RESERVE)
    return np.ndarray(array.shape, np.uint8, pages, array.offset, array.strides)[: shape[0]]


def image_name(index: int, image_format: ImageFormat = "png") -> str:
    """File name of a sample's image."""
    return f"{index:06d}{SUFFIXES[image_format]}"


def sha256(data: bytes) -> str:
    """Checksum, as records and manifests hold it."""
    return hashlib.sha256(data).hexdigest()

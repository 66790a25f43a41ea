"""The folder of one data set: where things lie in it, what is there, and whether it is what was asked for.

    renders/<variant>/
        manifest.json                 what made the folder, and how many samples are finished
        <split>/000123.png            images (.webp, .jpg)
        <split>/metadata.jsonl        one line a sample, sorted by index
        <split>/metadata.partial.jsonl    only while rendering: one line a finished image
        <split>/metadata.partial-0-of-4.jsonl    the same for one of several shards
        .cache/                       whatever programmes derive from the images

`SampleRecord` says what a line holds.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from phd_exp.records.errors import DatasetError, gist
from phd_exp.records.files import read_jsonl, read_plain, require_plain, write_atomic
from phd_exp.records.scenes import SampleRecord, Split
from phd_exp.records.shards import Shard
from phd_exp.records.spec import DatasetSpec, ImageFormat

SPLITS: tuple[Split, ...] = get_args(Split)
SUFFIXES: dict[ImageFormat, str] = {"png": ".png", "webp": ".webp", "jpeg": ".jpg"}


class Seal(BaseModel):
    """How many samples of a split are finished, and the checksum of its `metadata.jsonl`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    n: Annotated[int, Field(ge=0)]
    metadata_sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class Manifest(BaseModel):
    """What made a data set: `generator` is the version of the sampling code, `renderer` the path tracer."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    generator: int
    renderer: str
    spec: DatasetSpec
    splits: dict[Split, Seal]

    def count(self, split: Split) -> int:
        """Number of finished samples of a split."""
        return self.splits[split].n if split in self.splits else 0


@dataclass(frozen=True)
class DatasetFolder:
    """One data set on disk; `root` is its own folder, `renders/<variant>`."""

    root: Path

    def __post_init__(self) -> None:
        object.__setattr__(self, "root", Path(self.root).absolute())

    @property
    def manifest_path(self) -> Path:
        """The manifest."""
        return self.root / "manifest.json"

    @property
    def cache(self) -> Path:
        """Hidden, so that loaders which look for images do not look in here."""
        return self.root / ".cache"

    def split_folder(self, split: Split) -> Path:
        """Where the images of a split lie, and their metadata."""
        return self.root / split

    def metadata_path(self, split: Split) -> Path:
        """The finished samples of a split."""
        return self.root / split / "metadata.jsonl"

    @property
    def render_lock(self) -> Path:
        """Held by whoever writes here: alone by one, together by shards."""
        return self.cache / "render.lock"

    def journal_path(self, split: Split, shard: Shard | None = None) -> Path:
        """The samples that are finished while a split, or a shard of it, is being rendered."""
        share = "" if shard is None else f"-{shard.slug}"
        return self.root / split / f"metadata.partial{share}.jsonl"

    def journals(self, split: Split) -> list[Path]:
        """Journals that are there, of whatever shards."""
        return list(self.split_folder(split).glob("metadata.partial*.jsonl"))

    def image_path(self, split: Split, index: int, image_format: ImageFormat = "png") -> Path:
        """The image of a sample."""
        return self.root / split / image_name(index, image_format)

    @property
    def manifest(self) -> Manifest:
        """What made this folder.

        Raises:
            DatasetError: there is none, or it cannot be read.
        """
        try:
            return Manifest.model_validate_json(read_plain(self.manifest_path))
        except FileNotFoundError:
            raise DatasetError(
                f"{self.root}: no data set here (manifest.json is missing); render it first"
            ) from None
        except (OSError, ValidationError) as error:
            raise DatasetError(
                f"{self.manifest_path}: not a readable manifest ({gist(error)}); restore it, or move the folder "
                "away and render anew"
            ) from None

    def write_manifest(self, manifest: Manifest) -> None:
        """Replace the manifest. Raises OSError if the folder cannot be written."""
        write_atomic(self.manifest_path, manifest.model_dump_json(indent=2) + "\n")

    def records(self, split: Split, n: int | None = None) -> list[SampleRecord]:
        """The first `n` finished samples of a split (all by default), in the order of their indices.

        Raises:
            DatasetError: fewer than `n` are finished, or there is no data set.
            CorruptFileError: a line is not a record.
        """
        finished = self.manifest.count(split)
        wanted = finished if n is None else n
        if wanted > finished:
            raise DatasetError(
                f"{self.split_folder(split)}: {wanted} samples asked for, {finished} found; render the rest"
            )
        if wanted == 0:
            return []
        path = self.metadata_path(split)
        if not path.exists():
            raise DatasetError(f"{path}: missing though the manifest counts {finished} samples; render again")
        records = read_jsonl(path, SampleRecord.model_validate_json, limit=wanted, sealed=True)
        if [record.index for record in records] != list(range(wanted)):
            raise DatasetError(
                f"{path}: expected samples 0 to {wanted - 1} in order; restore it, or move the folder"
            )
        return records

    def missing(self, spec: DatasetSpec, n_train: int, n_test: int) -> dict[Split, list[int]]:
        """Indices of the samples asked for that are not finished, or whose image or line has gone, by split.

        Raises:
            DatasetError: the folder holds a data set of another specification.
        """
        wanted: dict[Split, int] = {"train": n_train, "test": n_test}
        if not self.manifest_path.exists():
            return {split: list(range(n)) for split, n in wanted.items()}
        manifest = self.require(spec)
        return {split: self._unfinished(split, n, manifest) for split, n in wanted.items()}

    def images(self, split: Split) -> set[str]:
        """Names of the images that are there."""
        folder = self.split_folder(split)
        return {entry.name for entry in folder.glob("[0-9]*.*")} if folder.is_dir() else set()

    def _unfinished(self, split: Split, n: int, manifest: Manifest) -> list[int]:
        there = self.images(split) if self.metadata_path(split).exists() else set()
        finished, kind = manifest.count(split), manifest.spec.image_format
        return [index for index in range(n) if index >= finished or image_name(index, kind) not in there]

    def require(self, spec: DatasetSpec) -> Manifest:
        """The manifest, of a folder that holds a data set of this specification.

        Raises:
            DatasetError: it holds another one, naming the first key that differs, or none.
        """
        manifest = self.manifest
        for key in DatasetSpec.model_fields:
            here, asked = getattr(manifest.spec, key), getattr(spec, key)
            if here != asked:
                raise DatasetError(
                    f"{self.root}: holds a data set with {key}={here}, but {key}={asked} is asked for; "
                    "move the folder away or choose another data.root"
                )
        return manifest


def image_name(index: int, image_format: ImageFormat = "png") -> str:
    """File name of a sample's image."""
    return f"{index:06d}{SUFFIXES[image_format]}"


def sha256(data: bytes) -> str:
    """Checksum as the records and the manifest write it."""
    return hashlib.sha256(data).hexdigest()


def checksum(file: Path) -> str:
    """The same of a plain file of any size. Raises OSError where it cannot be read."""
    require_plain(file)
    with open(file, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()

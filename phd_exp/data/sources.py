"""The interface of a source of samples, and rendered data sets as sources."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from phd_exp.data.backdrops import Backdrops
from phd_exp.data.batches import Batch
from phd_exp.data.images import cached_clearings, cached_images
from phd_exp.geometry.charts import DepthScale
from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.detections import DetectionLine
from phd_exp.records.scenes import SampleRecord, Split
from phd_exp.records.spec import DatasetSpec

Part = Literal["train", "held_out", "test"]
"""A part of the samples of a run; the first two are taken from the training split."""
PARTS: tuple[Part, ...] = ("train", "held_out", "test")

Known = Mapping[str, Sequence[Any]]
"""Columns of metadata: name -> one value per sample."""


class Source(ABC):
    """Abstract base class: samples to train, to choose and guarantee, and to test, all of one image size.

    Held-out samples are never used for training; there may be none.

    `depth` holds the constants that normalise depth, in the pixels of the samples' images; `constant_f` is the focal
    length of models that do not know it, the geometric mean of the extremes.
    """

    depth: DepthScale
    constant_f: float
    has_backdrops = False
    """Whether `training_backdrops` can be called."""

    @abstractmethod
    def samples(self, part: Part) -> Batch:
        """All samples of a part. Decodes their images on first use. Raises DatasetError."""

    @abstractmethod
    def known(self, part: Part) -> Known:
        """The columns to record with the predictions, in the order of the samples.

        Dependent samples, such as the frames of a video, have the same `block`; see `records.runs.choosing`.
        """

    @abstractmethod
    def count(self, part: Part) -> int:
        """The number of samples of a part."""

    def training_masks(self) -> UInt8[Tensor, "samples rows columns"] | None:
        """Share of each cell of the training images that shows the object, from 0 to 255; None: it is not known."""
        return None

    def training_backdrops(self) -> Backdrops:
        """What the training images show behind their objects."""
        raise NotImplementedError


def blocks(lines: Sequence[SampleRecord | DetectionLine]) -> dict[str, list[Any]]:
    """The column `block`, the number of the track, scene or image of each line, if two have the same; or nothing."""
    names = [next(at for at in (line.track, line.scene, line.file_name) if at is not None) for line in lines]
    number = {name: place for place, name in enumerate(dict.fromkeys(names))}
    return {"block": [number[name] for name in names]} if len(number) < len(names) else {}


class RenderedSource(Source):
    """The first samples of each split of a rendered data set, shrunk to `side` x `side` pixels.

    Held-out samples follow the training samples in the training split.

    The constants follow from the specification, before anything is rendered; for views of boxes, from the training
    samples. When an image shrinks, f and S shrink with it and mu_z0 grows.
    """

    def __init__(self, folder: DatasetFolder, spec: DatasetSpec, n: Mapping[Part, int], side: int) -> None:
        self.folder = folder
        self.spec = spec
        self.has_backdrops = spec.mesh is not None
        self.n = n
        self.side = side
        self.zoom = side / spec.sensor_size

    @cached_property
    def depth(self) -> DepthScale:  # type: ignore[override]
        """The constants that normalise depth."""
        spec = self.spec
        if not (spec.is_box and self._is_rendered):
            return DepthScale.from_ranges(f_range=spec.f_range, z_range=spec.z_range).scaled(self.zoom)
        return DepthScale.from_samples(*self._depths).scaled(self.zoom)

    @cached_property
    def constant_f(self) -> float:  # type: ignore[override]
        """The focal length of models that do not know it, px."""
        low, high = self.spec.f_range
        if self.spec.is_box and self._is_rendered:
            low, high = map(float, self._depths[1].aminmax())
        return self.zoom * float(np.sqrt(low * high))

    @property
    def _is_rendered(self) -> bool:
        """Whether all training samples are there; before, the parts of a run are only tried out."""
        folder, n = self.folder, self.n["train"]
        return folder.manifest_path.exists() and folder.manifest.count("train") >= n

    @cached_property
    def _depths(self) -> tuple[Tensor, Tensor]:
        """z and f of the training samples."""
        records = self.folder.records("train", self.n["train"])
        z, f = torch.tensor([(record.z, record.f) for record in records], dtype=torch.float64).T
        return z, f

    def samples(self, part: Part) -> Batch:
        split, of_split, rows = self._records(part)
        images, records = cached_images(self.folder, split, of_split, self.side), of_split[rows]
        xyz = torch.tensor([(record.x, record.y, record.z) for record in records], dtype=torch.float32)
        f = torch.tensor([self.zoom * record.f for record in records], dtype=torch.float32)
        return Batch(torch.from_numpy(images[rows]), xyz, f, float(self.side), torch.arange(len(records)))

    def known(self, part: Part) -> Known:
        names = ("file_name", "f", "S", "scale", "visibility", "truncation", "scene", "view")
        _, records, rows = self._records(part)
        records = records[rows]
        return {name: [getattr(record, name) for record in records] for name in names} | blocks(records)

    def count(self, part: Part) -> int:
        return self.n[part]

    def training_masks(self) -> UInt8[Tensor, "samples rows columns"]:
        return torch.from_numpy(self.folder.drawn("masks.npy", self.n["train"]))

    def training_backdrops(self) -> Backdrops:
        n, folder = self.n["train"], DatasetFolder(self.folder.root.with_name(self.spec.without_objects.variant))
        images = cached_images(folder, "train", folder.records("train", n), self.side)
        clear = cached_clearings(self.folder, n, self.side)
        return Backdrops(torch.from_numpy(images), torch.from_numpy(clear))

    def _records(self, part: Part) -> tuple[Split, list[SampleRecord], slice]:
        """The split of a part, all records of it that the run uses, and the rows of the part among them."""
        if part == "test":
            return "test", self.folder.records("test", self.n["test"]), slice(None)
        records = self.folder.records("train", self.n["train"] + self.n["held_out"])
        start = self.n["train"] if part == "held_out" else 0
        return "train", records, slice(start, start + self.n[part])

"""Where samples come from, and one such source: a rendered data set."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from phd_exp.data.batches import Batch
from phd_exp.data.images import cached_images
from phd_exp.geometry.charts import DepthScale
from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.scenes import SampleRecord, Split
from phd_exp.records.spec import DatasetSpec

Known = Mapping[str, Sequence[Any]]
"""What is known of samples besides their positions: name -> a value a sample."""


class Source(ABC):
    """Samples of two splits, all of one image size.

    `depth` holds the constants that normalise depth, in the pixels of the samples' images; `constant_f` is the focal
    length of models that know none, the geometric mean of the extremes.
    """

    depth: DepthScale
    constant_f: float

    @abstractmethod
    def samples(self, split: Split) -> Batch:
        """All samples of a split; decodes their images the first time. Raises DatasetError."""

    @abstractmethod
    def known(self, split: Split) -> Known:
        """The columns that the record of predictions repeats, in the order of the samples."""

    @abstractmethod
    def count(self, split: Split) -> int:
        """How many samples a split has."""


class RenderedSource(Source):
    """The first n samples of each split of a rendered data set, shrunk to image_size pixels a side.

    The constants follow from the specification, so that nothing need be rendered yet. Where an image shrinks, f and S
    shrink with it and mu_z0 grows.
    """

    def __init__(self, folder: DatasetFolder, spec: DatasetSpec, n: Mapping[Split, int], side: int) -> None:
        self.folder = folder
        self.n = n
        self.side = side
        self.zoom = side / spec.sensor_size
        self.depth = DepthScale.from_ranges(f_range=spec.f_range, z_range=spec.z_range).scaled(self.zoom)
        self.constant_f = self.zoom * float(np.sqrt(spec.f_range[0] * spec.f_range[1]))

    def samples(self, split: Split) -> Batch:
        records = self._records(split)
        return Batch(
            image=torch.from_numpy(cached_images(self.folder, split, records, self.side)),
            xyz=torch.tensor([(record.x, record.y, record.z) for record in records], dtype=torch.float32),
            f=torch.tensor([self.zoom * record.f for record in records], dtype=torch.float32),
            S=float(self.side),
            row=torch.arange(len(records)),
        )

    def known(self, split: Split) -> Known:
        names = ("file_name", "f", "S", "scale", "visibility", "truncation", "scene", "view")
        records = self._records(split)
        return {name: [getattr(record, name) for record in records] for name in names}

    def count(self, split: Split) -> int:
        return self.n[split]

    def _records(self, split: Split) -> list[SampleRecord]:
        return self.folder.records(split, self.n[split])

"""A rendered data set as Lightning takes it."""

from collections.abc import Sequence

import numpy as np
import torch
from lightning import LightningDataModule

from phd_exp.data.batches import Batch, BatchLoader
from phd_exp.data.images import cached_images
from phd_exp.geometry.charts import DepthScale
from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.scenes import SampleRecord, Split
from phd_exp.records.spec import DatasetSpec


class RenderedData(LightningDataModule):
    """The first n_train and n_test samples of a rendered data set, at image_size pixels a side.

    `depth` holds the constants that normalise depth, from the data set's specification, in the pixels of
    image_size: where an image shrinks, f and S shrink with it and mu_z0 grows.

    Raises DatasetError where the folder lacks samples or an image is damaged.
    """

    def __init__(
        self,
        folder: DatasetFolder,
        spec: DatasetSpec,
        *,
        n_train: int,
        n_test: int,
        image_size: int,
        batch_size: int,
        seed: int,
    ) -> None:
        super().__init__()
        self.folder = folder
        self.sizes: dict[Split, int] = {"train": n_train, "test": n_test}
        self.image_size = image_size
        self.batch_size = batch_size
        self.seed = seed
        self.zoom = image_size / spec.sensor_size
        self.depth = DepthScale.from_ranges(f_range=spec.f_range, z_range=spec.z_range).scaled(self.zoom)
        self.constant_f = self.zoom * float(np.sqrt(spec.f_range[0] * spec.f_range[1]))
        self.records: dict[Split, Sequence[SampleRecord]] = {}
        self.samples: dict[Split, Batch] = {}
        self.train_batches: BatchLoader | None = None

    def setup(self, stage: str | None = None) -> None:
        """Open both splits; decodes their images the first time."""
        for split, n in self.sizes.items():
            if split not in self.samples:
                self.records[split] = self.folder.records(split, n)
                self.samples[split] = self._samples(split)
        if self.train_batches is None:
            self.train_batches = BatchLoader(
                self.samples["train"], self.batch_size, shuffle=True, drop_last=True, seed=self.seed
            )

    def train_dataloader(self) -> BatchLoader:
        assert self.train_batches is not None, "setup comes first"
        return self.train_batches

    def val_dataloader(self) -> BatchLoader:
        # the paper reports the test split after every epoch; nothing is selected by it
        return self.test_dataloader()

    def test_dataloader(self) -> BatchLoader:
        return BatchLoader(
            self.samples["test"], self.batch_size, shuffle=False, drop_last=False, seed=self.seed
        )

    # Lightning restores the state of a loader in the middle of an epoch alone, that of a datamodule always
    def state_dict(self) -> dict[str, int]:
        return self.train_dataloader().place

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        self.train_dataloader().go_to(state_dict)

    def _samples(self, split: Split) -> Batch:
        records = self.records[split]
        images = cached_images(self.folder, split, records, self.image_size)
        return Batch(
            image=torch.from_numpy(images),
            xyz=torch.tensor([(record.x, record.y, record.z) for record in records], dtype=torch.float32),
            f=torch.tensor([self.zoom * record.f for record in records], dtype=torch.float32),
            S=float(self.image_size),
            row=torch.arange(len(records)),
        )

"""Samples that are noise, of any number and size: nothing is measured but what is done with them."""

import torch

from phd_exp.data.batches import Batch
from phd_exp.data.sources import Known, Part, Source
from phd_exp.geometry.charts import DepthScale
from phd_exp.training.config import RunConfig


class Noise(Source):
    """As many samples as a configuration says, of its size; no picture of anything."""

    def __init__(self, config: RunConfig) -> None:
        self.data = config.data
        zoom = config.data.image_size / 224
        self.depth = DepthScale.from_ranges((1200, 2000), (3, 5)).scaled(zoom)
        self.constant_f = 1550 * zoom

    def samples(self, part: Part) -> Batch:
        n, side = self.count(part), self.data.image_size
        random = torch.Generator().manual_seed(0)
        image = torch.randint(0, 256, (n, side, side, 3), dtype=torch.uint8, generator=random)
        xyz = torch.tensor([0.0, 0.0, 4.0]).expand(n, 3).clone()
        return Batch(image, xyz, torch.full((n,), self.constant_f), float(side), torch.arange(n))

    def known(self, part: Part) -> Known:
        return {}

    def count(self, part: Part) -> int:
        sizes = {"train": self.data.n_train, "held_out": 0, "test": self.data.n_test}
        return sizes[part] or 0

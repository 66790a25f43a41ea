"""The loop that the whole programme is held against."""

import copy

import torch

from phd_exp.data.batches import Batch
from phd_exp.training.config import RunConfig
from phd_exp.training.module import PositionModule
from phd_exp.training.network import precision


class Bare:
    """The loop that every tutorial begins with: a batch, forward, backward, step; nothing is measured or written."""

    name = "bare"

    def __init__(self, module: PositionModule, samples: Batch, config: RunConfig) -> None:
        self.regressor, self.loss = copy.deepcopy(module.regressor), module.loss
        self.optimizer = module.make_optimizer(self.regressor.parameters())
        self.samples = samples
        self.batch_size = config.data.batch_size
        self.mixed = precision(config.trainer) == "bf16-mixed"

    def epoch(self) -> int:
        for rows in torch.randperm(len(self.samples)).split(self.batch_size):
            batch = self.samples.select(rows)
            with torch.autocast("cpu", enabled=self.mixed):
                loss = self.loss(self.regressor(batch.image, batch.camera), batch.xyz).mean()
            self.optimizer.zero_grad()
            loss.backward()
            self.optimizer.step()
        return len(self.samples)

"""An augmentation that first replaces some training samples, or their backdrops."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from torch import Tensor

from phd_exp.data.batches import Augment, Batch


@dataclass(frozen=True, eq=False)
class Exchange:
    """An augmentation that first changes a share of the samples by means of a stock of images.

    Args:
        stock: the images that replace others.
        change: (stock, batch, which samples to change, numbers from 0 to 1 of each sample) -> the changed batch.
        n_own: random numbers per sample: one decides whether it changes, `change` uses the others.
        share: the share of the samples that change.
        then: the augmentation that follows.
    """

    stock: Any
    change: Callable[[Any, Batch, np.ndarray, np.ndarray], Batch]
    n_own: int
    share: float
    then: Augment | None

    @property
    def n_numbers(self) -> int:
        """Number of random numbers per sample; those of `then` come first."""
        return self.n_own + (self.then.n_numbers if self.then else 0)

    def __call__(self, batch: Batch, numbers: Float[Tensor, "batch n_numbers"]) -> Batch:
        """The samples, changed by uniform numbers from -1 to 1; their `row` is that of the originals."""
        of_then, own = numbers.tensor_split([-self.n_own], dim=1)
        uniform = ((own + 1) / 2).numpy()
        batch = self.change(self.stock, batch, uniform[:, 0] < self.share, uniform[:, 1:])
        return self.then(batch, of_then) if self.then else batch

"""Training samples before the backdrops of others, so that no object comes with its backdrop."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from phd_exp.data.batches import Augment, Batch
from phd_exp.geometry.motion import turned

N_NUMBERS = 5  # per sample, of an exchange alone


@dataclass(frozen=True, eq=False)
class Backdrops:
    """What the training images of a data set show behind their objects.

    Args:
        empty: the images without their objects.
        clear: share of each pixel of the images that shows no object, from 0 to 255.
    """

    empty: UInt8[Tensor, "samples side side 3"]
    clear: UInt8[Tensor, "samples side side"]


@dataclass(frozen=True, eq=False)
class BackdropExchange:
    """An augmentation that first shows samples before other backdrops: image + clear (empty' - empty).

    empty' is that of a random sample after a random one of the eight `symmetries`. The sum keeps shadows on the
    ground and the mixed colours of edges.

    Args:
        backdrops: of all training samples.
        share: the share of the samples that change.
        then: the augmentation that follows.
    """

    backdrops: Backdrops
    share: float
    then: Augment | None

    @property
    def n_numbers(self) -> int:
        """Number of random numbers per sample; those of `then` come first."""
        return N_NUMBERS + (self.then.n_numbers if self.then else 0)

    def __call__(self, batch: Batch, numbers: Float[Tensor, "batch n_numbers"]) -> Batch:
        """The samples, changed by uniform numbers from -1 to 1."""
        image = batch.image.clone()
        for place, (chosen, other, *signs) in enumerate(numbers[:, -N_NUMBERS:].tolist()):
            if chosen < 2 * self.share - 1:
                image[place] = self._before(image[place], int(batch.row[place]), other, signs)
        batch = replace(batch, image=image)
        return self.then(batch, numbers[:, :-N_NUMBERS]) if self.then else batch

    def _before(
        self, image: UInt8[Tensor, "side side 3"], row: int, other: float, signs: list[float]
    ) -> UInt8[Tensor, "side side 3"]:
        empty, clear = self.backdrops.empty, self.backdrops.clear[row, ..., None]
        new = turned(empty[int(len(empty) * (other + 1) / 2)], signs)
        change = clear * (new.float() - empty[row].float()) / 255
        return (image + change).round().clamp(0, 255).to(torch.uint8)

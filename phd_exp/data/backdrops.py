"""Training samples before the backdrops of others, so that no object comes with its backdrop."""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from phd_exp.data.batches import Augment, Batch

N_NUMBERS = 7  # per sample, of an exchange alone
FINEST = 4.0  # largest factor by which a backdrop is shown smaller, with finer texture


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

    empty' is that of one of two random samples, the one with more texture, since smooth backdrops are easy; it is
    `tiled` and perhaps transposed. The sum keeps shadows on the ground and the mixed colours of edges.

    Args:
        backdrops: of all training samples.
        share: the share of the samples that change.
        then: the augmentation that follows.
    """

    backdrops: Backdrops
    share: float
    then: Augment | None

    @cached_property
    def texture(self) -> Float[Tensor, " samples"]:
        """The mean difference between neighbouring pixels of each backdrop."""
        rows = ((one[1:].float() - one[:-1].float()).abs().mean() for one in self.backdrops.empty)
        return torch.stack(list(rows))

    @property
    def n_numbers(self) -> int:
        """Number of random numbers per sample; those of `then` come first."""
        return N_NUMBERS + (self.then.n_numbers if self.then else 0)

    def __call__(self, batch: Batch, numbers: Float[Tensor, "batch n_numbers"]) -> Batch:
        """The samples, changed by uniform numbers from -1 to 1."""
        image, uniform = batch.image.clone(), (numbers[:, -N_NUMBERS:] + 1) / 2
        pairs = (len(self.backdrops.empty) * uniform[:, 1:3]).long()
        others = pairs.gather(1, self.texture[pairs].argmax(dim=1, keepdim=True)).flatten()
        for place in (uniform[:, 0] < self.share).nonzero().flatten().tolist():
            fine, down, right, turn = uniform[place, 3:].tolist()
            new = tiled(self.backdrops.empty[int(others[place])], FINEST**fine, down, right)
            new = new.transpose(0, 1) if turn < 0.5 else new
            image[place] = self._before(new, image[place], int(batch.row[place]))
        batch = replace(batch, image=image)
        return self.then(batch, numbers[:, :-N_NUMBERS]) if self.then else batch

    def _before(
        self, new: UInt8[Tensor, "side side 3"], image: UInt8[Tensor, "side side 3"], row: int
    ) -> UInt8[Tensor, "side side 3"]:
        """The image of a row before a new backdrop."""
        change = new.float() - self.backdrops.empty[row].float()
        share = self.backdrops.clear[row, ..., None] / 255
        return change.mul_(share).add_(image).round_().clamp_(0, 255).to(torch.uint8)


def tiled(
    image: UInt8[Tensor, "side side 3"], fine: float, down: float, right: float
) -> UInt8[Tensor, "side side 3"]:
    """The plane that an image and its mirror images tile, shown `fine` times smaller from a place on.

    `down` and `right` are shares of the period, which is two images.
    """
    side = len(image)
    rows, columns = ((torch.arange(side) * fine + 2 * side * start).long() % (2 * side) for start in (down, right))
    rows, columns = (torch.minimum(place, 2 * side - 1 - place) for place in (rows, columns))
    return image.index_select(0, rows).index_select(1, columns)

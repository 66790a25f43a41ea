"""Exchange the backdrops of training images, so that a network cannot learn which object has which backdrop."""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from phd_exp.data.batches import Augment, Batch

NUMBERS = (1, 2, 4)  # per sample: whether it changes; two samples; zoom, two shifts and transposition of the backdrop
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
        return sum(NUMBERS) + (self.then.n_numbers if self.then else 0)

    def __call__(self, batch: Batch, numbers: Float[Tensor, "batch n_numbers"]) -> Batch:
        """The samples, changed by uniform numbers from -1 to 1."""
        of_then, own = numbers.tensor_split([-sum(NUMBERS)], dim=1)
        changes, pairs, views = ((own + 1) / 2).split(NUMBERS, dim=1)
        pairs = (len(self.backdrops.empty) * pairs).long()
        others = pairs.gather(1, self.texture[pairs].argmax(dim=1, keepdim=True)).flatten()
        image = batch.image.clone()
        for place in (changes[:, 0] < self.share).nonzero().flatten().tolist():
            fine, down, right, turn = views[place].tolist()
            new, row = tiled(self.backdrops.empty[others[place]], FINEST**fine, down, right), batch.row[place]
            change = (new.transpose(0, 1) if turn < 0.5 else new).float() - self.backdrops.empty[row].float()
            share = self.backdrops.clear[row, ..., None] / 255
            image[place] = change.mul_(share).add_(image[place]).round_().clamp_(0, 255)
        batch = replace(batch, image=image)
        return self.then(batch, of_then) if self.then else batch


def tiled(
    image: UInt8[Tensor, "side side 3"], fine: float, down: float, right: float
) -> UInt8[Tensor, "side side 3"]:
    """A view, as large as the image, of the plane that the image and its mirror images tile.

    It begins at the place (`down`, `right`), in units of the tiling's period, which is two images. Pixels are picked
    without interpolation.

    Args:
        fine: how many times smaller the view shows the image; more is finer texture.
    """
    side = len(image)
    rows, columns = ((torch.arange(side) * fine + 2 * side * start).long() % (2 * side) for start in (down, right))
    rows, columns = (torch.minimum(place, 2 * side - 1 - place) for place in (rows, columns))
    return image.index_select(0, rows).index_select(1, columns)

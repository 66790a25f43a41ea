"""Exchange the backdrops of training images, so that a network cannot learn which object has which backdrop."""

from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from phd_exp.data.batches import Augment, Batch
from phd_exp.data.photometry import change, levels, on

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

    @property
    def n_bytes(self) -> int:
        """Memory that they take."""
        return self.empty.nbytes + self.clear.nbytes

    def to(self, device: torch.device) -> "Backdrops":
        """The same on a device."""
        return Backdrops(self.empty.to(device), self.clear.to(device))


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
    def texture(self) -> Float[np.ndarray, " samples"]:
        """The mean difference between neighbouring pixels of each backdrop."""
        rows = ((one[1:].float() - one[:-1].float()).abs().mean() for one in self.backdrops.empty)
        return torch.stack(list(rows)).cpu().numpy()

    @property
    def n_numbers(self) -> int:
        """Number of random numbers per sample; those of `then` come first."""
        return sum(NUMBERS) + (self.then.n_numbers if self.then else 0)

    def __call__(self, batch: Batch, numbers: Float[Tensor, "batch n_numbers"]) -> Batch:
        """The samples, changed by uniform numbers from -1 to 1."""
        of_then, own = numbers.tensor_split([-sum(NUMBERS)], dim=1)
        changes, pairs, views = (part.numpy() for part in ((own + 1) / 2).split(NUMBERS, dim=1))
        pairs = (len(self.backdrops.empty) * pairs).astype(np.int64)
        others = np.take_along_axis(pairs, self.texture[pairs].argmax(axis=1)[:, None], axis=1)[:, 0]
        image = batch.image.clone(memory_format=torch.contiguous_format)
        formula = partial(self._before, batch.row)
        change(image, changes[:, 0] < self.share, formula, np.arange(len(batch)), others, views)
        batch = replace(batch, image=image)
        return self.then(batch, of_then) if self.then else batch

    def _before(
        self,
        row: Int[Tensor, " batch"],
        image: UInt8[Tensor, "chosen side side 3"],
        place: Int[np.ndarray, " chosen"],
        others: Int[np.ndarray, " chosen"],
        views: Float[np.ndarray, "chosen 4"],
    ) -> UInt8[Tensor, "chosen side side 3"]:
        """The images of these places in the batch before views of other backdrops."""
        empty, clear = self.backdrops.empty, self.backdrops.clear
        rows = row.index_select(0, on(row, place)).to(empty.device)
        old, share = (part.index_select(0, rows).to(image.device) for part in (empty, clear))
        new = tiled(empty, others, views).to(image.device)
        return levels((new.float() - old.float()).mul_(share[..., None] / 255).add_(image))


def tiled(
    images: UInt8[Tensor, "samples side side 3"], which: Int[np.ndarray, " n"], views: Float[np.ndarray, "n 4"]
) -> UInt8[Tensor, "n side side 3"]:
    """Views, as large as the images, of the planes that these images and their mirror images tile.

    The numbers of a view are from 0 to 1. The first is for how many times smaller the image appears, 1 to `FINEST`.
    The view begins at the next two, down and right, in units of the tiling's period, which is two images. It is
    transposed if the last one is below 1/2. Pixels are picked without interpolation.
    """
    side, (fine, down, right, turn) = images.shape[1], views.T
    steps = np.arange(side) * (FINEST**fine)[:, None].astype(np.float32)
    starts = ((2 * side * start)[:, None].astype(np.float32) for start in (down, right))
    row, column = ((steps + start).astype(np.int64) % (2 * side) for start in starts)
    row, column = (np.minimum(place, 2 * side - 1 - place) for place in (row, column))
    row, transposed = side * (side * which[:, None] + row), (turn < 0.5)[:, None]
    outer, inner = on(images, np.where(transposed, column, row)), on(images, np.where(transposed, row, column))
    pixels = (outer[:, :, None] + inner[:, None, :]).flatten()
    return images.view(-1, 3).index_select(0, pixels).view(-1, side, side, 3)

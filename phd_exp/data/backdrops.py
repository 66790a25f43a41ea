"""Exchange the backdrops of training images, so that a network cannot learn which object has which backdrop."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from phd_exp.data.batches import Batch
from phd_exp.data.photometry import change, levels, many, on

BACKDROP_NUMBERS = 7  # per sample: whether it changes, and those of `before_others`
MOST_CONTRAST = 0.5  # largest factor of the contrast of a plain backdrop
NEAR = 40  # levels: largest difference between the objects and a plain backdrop near their level
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

    @cached_property
    def texture(self) -> Float[np.ndarray, " samples"]:
        """The mean difference between neighbouring pixels of each backdrop."""
        rows = ((one[1:].float() - one[:-1].float()).abs().mean() for one in self.empty)
        return torch.stack(list(rows)).cpu().numpy()

    @property
    def n_bytes(self) -> int:
        """Memory that they take."""
        return self.empty.nbytes + self.clear.nbytes

    def to(self, device: torch.device) -> "Backdrops":
        """The same on a device."""
        return Backdrops(self.empty.to(device), self.clear.to(device))

    def of(
        self, batch: Batch, place: Int[np.ndarray, " some"]
    ) -> tuple[UInt8[Tensor, "some side side 3"], UInt8[Tensor, "some side side"]]:
        """`empty` and `clear` of the samples at these places of a batch, on the device of its images."""
        rows = batch.row.index_select(0, on(batch.row, place))
        empty, clear = (
            part.index_select(0, rows.to(part.device)).to(batch.image.device) for part in (self.empty, self.clear)
        )
        return empty, clear


def before_others(
    backdrops: Backdrops,
    batch: Batch,
    chosen: Bool[np.ndarray, " batch"],
    numbers: Float[np.ndarray, "batch 6"],
    plain: float = 0.0,
) -> Batch:
    """The batch, with some samples in front of other backdrops: image + clear (empty' - empty).

    empty' is that of one of two random samples, the one with more texture, since smooth backdrops are easy; it is
    `tiled` and perhaps transposed. The sum keeps shadows on the ground and the mixed colours of edges.

    The share `plain` of the new backdrops is nearly plain, like a table top: little contrast and a random level. For
    half of these, the level is near that of the objects, whose outlines are then hard to see.

    Args:
        backdrops: of all training samples.
        batch: some of these samples.
        chosen: which of them to change.
        numbers: from 0 to 1; two choose samples, four the zoom, both shifts and the transposition of the backdrop.
        plain: share of the new backdrops that are nearly plain.
    """

    def exchanged(
        image: UInt8[Tensor, "some side side 3"],
        place: Int[np.ndarray, " some"],
        others: Int[np.ndarray, " some"],
        views: Float[np.ndarray, "some 4"],
        kinds: Float[np.ndarray, "some 4"],
    ) -> UInt8[Tensor, "some side side 3"]:
        old, share = backdrops.of(batch, place)
        new = tiled(backdrops.empty, others, views).to(image.device).float()
        if plain:
            new = _toned(new, _level_of_objects(image, share), on(image, kinds))
        return levels((new - old.float()).mul_(share[..., None] / 255).add_(image))

    pairs = (len(backdrops.empty) * numbers[:, :2]).astype(np.int64)
    others = np.take_along_axis(pairs, backdrops.texture[pairs].argmax(axis=1)[:, None], axis=1)[:, 0]
    image = batch.image.clone(memory_format=torch.contiguous_format)
    is_plain, *tones = many(numbers[:, :2], 4).T
    kinds = np.column_stack([is_plain < plain, *tones])
    change(image, chosen, exchanged, np.arange(len(batch)), others, numbers[:, 2:], kinds)
    return replace(batch, image=image)


def _level_of_objects(
    image: UInt8[Tensor, "some side side 3"], clear: UInt8[Tensor, "some side side"]
) -> Float[Tensor, " some"]:
    """The mean level of the pixels that show objects."""
    covered = 1 - clear.flatten(1).float() / 255
    return (covered * image.float().mean(-1).flatten(1)).sum(1) / covered.sum(1).clamp_min(1)


def _toned(
    new: Float[Tensor, "some side side 3"], of_objects: Float[Tensor, " some"], kinds: Float[Tensor, "some 4"]
) -> Float[Tensor, "some side side 3"]:
    """The backdrops, nearly plain where the first of four numbers is 1.

    The others are from 0 to 1. The second sets the contrast and the third the level: any level if the fourth is below
    1/2, otherwise one near that of the objects.
    """
    is_plain, contrast, level, is_free = kinds.T
    level = torch.where(is_free < 0.5, 255 * level, of_objects + NEAR * (2 * level - 1))
    contrast = torch.where(is_plain > 0, MOST_CONTRAST * contrast**2, 1.0)
    shift = torch.where(is_plain > 0, level - contrast * new.flatten(1).mean(1), 0.0)
    return new.mul_(contrast[:, None, None, None]).add_(shift[:, None, None, None])


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

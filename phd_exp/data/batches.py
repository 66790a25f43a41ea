"""Batches of a data set in memory, in an order that depends on (seed, epoch) alone."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from numpy.typing import NDArray
from torch import Tensor

from phd_exp.geometry.camera import Camera

SIGNS = 3  # the first random numbers of a row, whose signs are stratified
OCTANTS = 2**SIGNS
HOST = torch.device("cpu")


@dataclass(frozen=True)
class Batch:
    """Samples, one per row: the inputs of a network and the truth."""

    image: UInt8[Tensor, "batch height width 3"]
    xyz: Float[Tensor, "batch 3"]
    """True position in the camera frame, metres."""
    f: Float[Tensor, " batch"]
    """Focal length in pixels of `image`, which may have been shrunk."""
    S: float
    """Side of `image` in pixels."""
    row: Int[Tensor, " batch"]
    """Index of each sample in its split."""
    mask: UInt8[Tensor, "batch rows columns"] | None = None
    """Share of each cell of the image that shows the object, from 0 to 255, if it is known."""
    mask_weight: Float[Tensor, " batch"] | None = None
    """Weight of each mask in a loss, 0 for an unknown mask; None: 1 for all."""

    @property
    def camera(self) -> Camera:
        """The true cameras of the samples, in the pixels of `image`."""
        return Camera.unchecked(self.f, self.S)

    def __len__(self) -> int:
        return len(self.row)

    def select(self, rows: Int[Tensor, " rows"] | slice) -> "Batch":
        """The samples of these rows."""
        if isinstance(rows, slice):
            return self._map(lambda part: part[rows])
        place = rows.to(self.image.device, non_blocking=True)
        return self._map(lambda part: part.index_select(0, place))  # on a CPU, twenty times as fast as part[place]

    def to(self, device: torch.device | str) -> "Batch":
        """The same samples on a device."""
        return self._map(lambda part: part.to(device))

    def copied(self, device: torch.device) -> "Batch":
        """The same samples on another device; a GPU copies from page-locked memory while it computes."""
        part = self._map(Tensor.pin_memory) if device.type == "cuda" else self
        return part._map(lambda part: part.to(device, non_blocking=True))

    @property
    def n_bytes(self) -> int:
        """Memory that the samples take."""
        return sum(part.nbytes for part in vars(self).values() if isinstance(part, Tensor))

    def _map(self, function: Callable[[Tensor], Tensor]) -> "Batch":
        parts = {name: part for name, part in vars(self).items() if isinstance(part, Tensor)}
        changed: dict[str, Any] = {name: function(part) for name, part in parts.items()}
        return replace(self, **changed)


@runtime_checkable
class Augment(Protocol):
    """A random change of samples that keeps their labels exact."""

    @property
    def n_numbers(self) -> int:
        """Number of random numbers per sample."""
        ...

    def __call__(self, batch: Batch, numbers: Float[Tensor, "batch n_numbers"]) -> Batch:
        """The samples, changed by uniform numbers from -1 to 1."""
        ...


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


@dataclass(eq=False)
class BatchLoader:
    """Iterates over the batches of one epoch; each iteration is the next epoch.

    `shuffle` is for training: a random order, without the last batch if it is not full. The order is a function of
    (seed, epoch). The state holds the epoch and the next batch, so a resumed epoch continues with its remaining
    batches; a DataLoader would repeat its first ones.

    With several processes, rank r takes the rows r, r + world, ... of every batch. No row is repeated; a rank skips a
    last batch without a row for it.

    `augment` changes a batch given `n_numbers` random numbers per row. They are a function of (seed, epoch, batch)
    for the whole batch, so they do not depend on `world`. The signs of the first three numbers of a row are
    stratified: within eight epochs each row gets all eight combinations.

    Batches are on `device`, where `augment` works; samples elsewhere are copied batch by batch.

    Examples:
        >>> n = 4
        >>> samples = Batch(torch.zeros(n, 8, 8, 3, dtype=torch.uint8), torch.ones(n, 3), torch.ones(n), 8.0,
        ...                 torch.arange(n))
        >>> loader = BatchLoader(samples, 3, shuffle=True, seed=0)
        >>> [batch.row.tolist() for batch in loader]
        [[1, 0, 3]]
    """

    samples: Batch
    batch_size: int
    shuffle: bool
    seed: int
    rank: int = 0
    world: int = 1
    augment: Augment | None = None
    device: torch.device = HOST
    epoch: int = field(default=-1, init=False)
    next_batch: int = field(default=0, init=False)
    resumes: bool = field(default=False, init=False)

    def __len__(self) -> int:
        whole, rest = divmod(len(self.samples), self.batch_size)
        return whole + (rest > self.rank and not self.shuffle)

    def __iter__(self) -> Iterator[Batch]:
        if not self.resumes:
            self.epoch += 1  # at the start, since an iterator may not be exhausted
            self.next_batch = 0
        self.resumes = False
        order = self.order(self.epoch)
        signs = self.signs(self.epoch) if self.augment else np.empty(0)
        starts = range(self.next_batch * self.batch_size, len(self) * self.batch_size, self.batch_size)
        for start in starts:
            rows, number = order[start : start + self.batch_size], self.next_batch
            batch = self.samples.select(rows[self.rank :: self.world])
            if self.device != batch.image.device:
                batch = batch.copied(self.device)
            self.next_batch += 1
            yield self._augmented(batch, number, rows, signs) if self.augment else batch

    def _augmented(
        self, batch: Batch, number: int, rows: Int[Tensor, " batch"], signs: Int[np.ndarray, "samples 3"]
    ) -> Batch:
        """The share of this process of a batch of these rows, changed by numbers drawn for all of it."""
        assert self.augment is not None
        numbers = self._random(self.epoch, number).uniform(-1, 1, (len(rows), self.augment.n_numbers))
        first = numbers[:, :SIGNS]
        first[:] = signs[rows, : first.shape[1]] * np.abs(first)
        return self.augment(batch, torch.from_numpy(numbers[self.rank :: self.world]))

    def order(self, epoch: int) -> Int[Tensor, " samples"]:
        """The rows in the order of an epoch."""
        if not self.shuffle:
            return torch.arange(len(self.samples))
        return torch.from_numpy(self._random(epoch).permutation(len(self.samples)))

    def signs(self, epoch: int) -> NDArray[np.int64]:
        """The signs (samples, 3) of an epoch: every eight epochs, each sample gets all eight in random order."""
        block, place = divmod(epoch, OCTANTS)
        orders = np.tile(np.arange(OCTANTS), (len(self.samples), 1))
        octant = self._random(block, 0, 0).permuted(orders, axis=1)[:, place]
        return 1 - 2 * ((octant[:, None] >> np.arange(SIGNS)) & 1)

    def _random(self, *place: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=place))

    def state_dict(self) -> dict[str, int]:
        """The position of the iteration, for a checkpoint."""
        return {"epoch": self.epoch, "next_batch": self.next_batch}

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        """Continue the next iteration at this position."""
        self.epoch, self.next_batch = state_dict["epoch"], state_dict["next_batch"]
        self.resumes = 0 < self.next_batch < len(self)

"""Batches of a data set in memory, in an order that depends on (seed, epoch) alone."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
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

    def to(self, device: torch.device | str, non_blocking: bool = False) -> "Batch":
        """The same samples on a device."""
        return self._map(lambda part: part.to(device, non_blocking=non_blocking))

    def pinned(self) -> "Batch":
        """The same samples in page-locked memory, from which a GPU copies while it computes."""
        return self._map(Tensor.pin_memory)

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

    Batches are on `device`, where `augment` works. If the samples are elsewhere, the next batch is selected and
    copied in a thread while the last one is in use.

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
        rows = [order[start : start + self.batch_size] for start in starts]
        for of_batch, batch in zip(rows, self._selected(rows), strict=True):
            number = self.next_batch
            self.next_batch += 1
            yield self._augmented(batch, number, of_batch, signs) if self.augment else batch

    def _selected(self, rows: Iterable[Int[Tensor, " _"]]) -> Iterator[Batch]:
        """The samples of this process in batches of these rows, on the device."""
        mine = [of_batch[self.rank :: self.world] for of_batch in rows]
        if self.samples.image.device == self.device:
            yield from map(self.samples.select, mine)
        else:
            yield from one_ahead(self._copied, mine)

    def _copied(self, rows: Int[Tensor, " rows"]) -> Batch:
        batch = self.samples.select(rows)
        return (batch.pinned() if self.device.type == "cuda" else batch).to(self.device, non_blocking=True)

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


def one_ahead(make: Callable[[Any], Batch], arguments: Iterable[Any]) -> Iterator[Batch]:
    """make(argument) for each in order; the next is made in a thread while the last is in use."""
    with ThreadPoolExecutor(1) as thread:
        waiting = None
        for argument in arguments:
            following = thread.submit(make, argument)
            if waiting:
                yield waiting.result()
            waiting = following
        if waiting:
            yield waiting.result()

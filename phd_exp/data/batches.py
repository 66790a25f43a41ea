"""Batches of a resident data set, in an order that depends on (seed, epoch) alone."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from numpy.typing import NDArray
from torch import Tensor

from phd_exp.geometry.camera import Camera

OCTANTS = 8
"""Combinations of three signs."""


@dataclass(frozen=True)
class Batch:
    """Samples, one a row: what a network sees, what it is told, and the truth."""

    image: UInt8[Tensor, "batch height width 3"]
    xyz: Float[Tensor, "batch 3"]
    """True position in the camera frame, metres."""
    f: Float[Tensor, " batch"]
    """Focal length in pixels of `image`, not of the sensor it was rendered on."""
    S: float
    """Side of `image` in pixels."""
    row: Int[Tensor, " batch"]
    """Place of each sample in its split."""

    @property
    def camera(self) -> Camera:
        """The true cameras of the samples, in the pixels of `image`."""
        return Camera(self.f, self.S)

    def __len__(self) -> int:
        return len(self.row)

    def select(self, rows: Int[Tensor, " rows"]) -> "Batch":
        """The samples of these rows."""
        return Batch(self.image[rows], self.xyz[rows], self.f[rows], self.S, self.row[rows])

    def to(self, device: torch.device | str, non_blocking: bool = False) -> "Batch":
        """The same samples on a device."""

        def moved(tensor: Tensor) -> Tensor:
            return tensor.to(device, non_blocking=non_blocking)

        return Batch(moved(self.image), moved(self.xyz), moved(self.f), self.S, moved(self.row))


@runtime_checkable
class Augment(Protocol):
    """A random change of samples, of which the labels stay exact."""

    n_numbers: ClassVar[int]
    """How many random numbers decide over one sample."""

    def __call__(self, batch: Batch, numbers: Float[Tensor, "batch n_numbers"]) -> Batch:
        """The samples, changed as uniform numbers from -1 to 1 say."""
        ...


class BatchLoader:
    """Iterates over the batches of one epoch; each iteration is the next epoch.

    The order is a function of (seed, epoch), never of what ran before, and the state holds both the epoch and how far
    it has come: a resumed epoch goes on with the batches that were left, where a DataLoader would replay its first
    ones.

    Of several processes that train together each takes its share of every batch: rank r the rows r, r + world, ...
    No row is seen twice, and a last batch that has no row for a rank does not exist for it.

    `augment` changes a batch given random numbers, `n_numbers` a row. They are a function of (seed, epoch, batch) for
    the whole batch, of which each process takes its share, so they depend neither on what ran before nor on `world`.
    The signs of a row's first three numbers are stratified: within eight epochs each row gets all eight combinations.
    """

    def __init__(
        self,
        samples: Batch,
        batch_size: int,
        *,
        shuffle: bool,
        drop_last: bool,
        seed: int,
        rank: int = 0,
        world: int = 1,
        augment: Augment | None = None,
    ) -> None:
        self.samples = samples
        self.batch_size = batch_size
        self.shuffle = shuffle
        self.drop_last = drop_last
        self.seed = seed
        self.rank = rank
        self.world = world
        self.augment = augment
        self.epoch = -1
        self.next_batch = 0

    def __len__(self) -> int:
        whole, rest = divmod(len(self.samples), self.batch_size)
        return whole + (rest > self.rank and not self.drop_last)

    def __iter__(self) -> Iterator[Batch]:
        if self.next_batch in (0, len(self)):  # else: resumed in the middle of an epoch
            self.epoch += 1  # at the start, since an iterator is not always exhausted
            self.next_batch = 0
        order = self.order(self.epoch)
        signs = self.signs(self.epoch) if self.augment else np.empty(0)
        while self.next_batch < len(self):
            number, start = self.next_batch, self.next_batch * self.batch_size
            self.next_batch += 1
            rows = order[start : start + self.batch_size]
            batch = self.samples.select(rows[self.rank :: self.world])
            yield self.augment(batch, self._numbers(signs[rows], number)) if self.augment else batch

    def order(self, epoch: int) -> Int[Tensor, " samples"]:
        """The rows in the order in which that epoch visits them."""
        if not self.shuffle:
            return torch.arange(len(self.samples))
        return torch.from_numpy(self._random(epoch).permutation(len(self.samples)))

    def _numbers(self, signs: NDArray[np.int64], number: int) -> Float[Tensor, "share n_numbers"]:
        """This process's share of a batch's random numbers, uniform from -1 to 1, given the signs of the first."""
        assert self.augment is not None
        numbers = self._random(self.epoch, number).uniform(-1, 1, (len(signs), self.augment.n_numbers))
        numbers[:, :3] = signs * np.abs(numbers[:, :3])
        return torch.from_numpy(numbers[self.rank :: self.world])

    def signs(self, epoch: int) -> NDArray[np.int64]:
        """The signs (samples, 3) of an epoch: a random order of all eight for each sample in every eight epochs."""
        block, place = divmod(epoch, OCTANTS)
        orders = np.tile(np.arange(OCTANTS), (len(self.samples), 1))
        octant = self._random(block, 0, 0).permuted(orders, axis=1)[:, place]
        return 1 - 2 * ((octant[:, None] >> np.arange(3)) & 1)

    def _random(self, *place: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=place))

    def state_dict(self) -> dict[str, int]:
        """Where the iteration stands, for a checkpoint."""
        return {"epoch": self.epoch, "next_batch": self.next_batch}

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        """Let the next iteration go on from there."""
        self.epoch, self.next_batch = state_dict["epoch"], state_dict["next_batch"]

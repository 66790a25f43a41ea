"""A data set as a LightningDataModule."""

from dataclasses import replace
from functools import partial
from typing import TypeVar

import torch
from lightning import LightningDataModule
from torch import Tensor

from phd_exp.data.backdrops import BACKDROP_NUMBERS, Backdrops, before_others
from phd_exp.data.batches import Augment, Batch, BatchLoader, Exchange
from phd_exp.data.photographs import PHOTOGRAPH_NUMBERS, Photographs, replaced
from phd_exp.data.prints import PRINT_NUMBERS, printed
from phd_exp.data.sources import PARTS, Part, Source
from phd_exp.geometry.camera import Camera
from phd_exp.records.errors import ConfigError, DatasetError
from phd_exp.records.processes import announce
from phd_exp.records.runs import choosing

Held = TypeVar("Held", Batch, Backdrops)


class PositionData(LightningDataModule):
    """The samples of a source in batches, or the share of one of several processes (`rank` of `world`).

    `augment` changes training batches only. Before it, the share `backdrops` of their samples is put in front of
    other backdrops (the share `plain` of these is nearly plain), the share `prints` gets prints on the objects, and
    `photographs` replace their share of the samples. With `masks`, these batches have the masks of the source, if
    it has any. The validation evaluates the test samples, which choose nothing, and with `held_out` also the held-out
    samples that may choose; all of these are the source's.

    Raises ConfigError if there are too few samples for one batch, or if the processes cannot share them; on `setup`,
    DatasetError if the source lacks samples or an image is damaged.
    """

    def __init__(
        self,
        source: Source,
        *,
        batch_size: int = 32,
        seed: int = 0,
        rank: int = 0,
        world: int = 1,
        augment: Augment | None = None,
        held_out: bool = False,
        masks: bool = False,
        backdrops: float = 0.0,
        plain: float = 0.0,
        prints: float = 0.0,
        photographs: Photographs | None = None,
    ) -> None:
        super().__init__()
        for key, share in (("backdrops", backdrops), ("prints", prints)):
            if share and not source.has_backdrops:
                raise ConfigError(
                    f"recipe.augmentation.{key}: got {share}, but what these images show behind their objects is "
                    "not known; expected 0, or data=object"
                )
        if plain and not backdrops:
            raise ConfigError(
                f"recipe.augmentation.plain: got {plain}, a share of the other backdrops, but backdrops=0 has none; "
                "expected 0, or recipe.augmentation.backdrops above 0, as in recipe=strong"
            )
        if batch_size > source.count("train"):
            raise ConfigError(
                f"data: batch_size={batch_size} is larger than the {source.count('train')} training samples there "
                "are: not one batch is full; choose a smaller data.batch_size"
            )
        if batch_size % world:
            raise ConfigError(
                f"trainer.devices: got {world}, which does not divide batch_size={batch_size}: the mean of the "
                "shares' gradients is that of the batch only if all shares are of one size"
            )
        for part in PARTS:
            n = -(-source.count(part) // (2 if part == "held_out" else 1))
            if 0 < n < world:
                raise ConfigError(f"trainer.devices: got {world}, more than the {n} samples of {part} in a pass")
        self.source = source
        self.augment = augment
        self.masks = masks
        self.backdrops, self.plain, self.prints = backdrops, plain, prints
        self.photographs = photographs
        self.validated: tuple[Part, ...] = ("test", "held_out") if held_out else ("test",)
        self.batches = partial(BatchLoader, batch_size=batch_size, seed=seed, rank=rank, world=world)
        self.samples: dict[Part, Batch] = {}
        self.train_batches: BatchLoader | None = None

    def setup(self, stage: str | None = None) -> None:
        """Open every part that has samples. Decodes their images on first use.

        Raises DatasetError for a focal length that is not positive and finite; batches are not checked again.
        """
        for part in PARTS:
            if part not in self.samples and self.source.count(part):
                samples = self.samples[part] = self.source.samples(part)
                try:
                    Camera(samples.f, samples.S)
                except ValueError as error:
                    raise DatasetError(f"{part} samples: {error}") from None
                if self.masks and part == "train":
                    self.samples[part] = replace(self.samples[part], mask=self.source.training_masks())
        if self.train_batches is None:
            samples = self.samples["train"]
            self.train_batches = self.batches(samples, shuffle=True, augment=self._training_augment(samples))

    def _training_augment(self, samples: Batch) -> Augment | None:
        """The augmentation of training samples, after the exchanges of backdrops, prints and photographs."""
        augment = self.augment
        if self.photographs:
            stock, share = self.photographs.samples(samples), self.photographs.share
            augment = Exchange(stock, replaced, PHOTOGRAPH_NUMBERS, share, augment)
        if not (self.backdrops or self.prints):
            return augment
        backdrops = self.source.training_backdrops()  # changed first, since those of photographs are not known
        if self.prints:
            augment = Exchange(backdrops, printed, PRINT_NUMBERS, self.prints, augment)
        if self.backdrops:
            change = partial(before_others, plain=self.plain)
            augment = Exchange(backdrops, change, BACKDROP_NUMBERS, self.backdrops, augment)
        return augment

    def move_to(self, device: torch.device) -> None:
        """Hold the samples on the device that trains, as far as half of its free memory suffices for each part.

        Those without room stay in host memory, memory-mapped, and are copied batch by batch; a line says so.
        """
        for part, samples in self.samples.items():
            self.samples[part] = held_on(device, samples, f"the {part} samples")
        self.batches = partial(self.batches, device=device)
        loader = self.train_dataloader()
        loader.samples, loader.device = self.samples["train"], device
        loader.augment = _moved(loader.augment, device)

    def train_dataloader(self) -> BatchLoader:
        assert self.train_batches is not None, "setup comes first"
        return self.train_batches

    def val_dataloader(self) -> list[BatchLoader]:
        return [self.in_order(part, self._rows(part)) for part in self.validated]

    def _rows(self, part: Part) -> Tensor | slice:
        is_half = part == "held_out"
        return torch.from_numpy(choosing(self.source.known(part)).nonzero()[0]) if is_half else slice(None)

    def test_dataloader(self) -> BatchLoader:
        return self.in_order("test")

    predict_dataloader = test_dataloader

    def in_order(self, part: Part, rows: Tensor | slice = slice(None)) -> BatchLoader:
        """Every sample of a part, or of some rows, once, in the order of the data set."""
        return self.batches(self.samples[part].select(rows), shuffle=False)

    # Lightning restores the state of a datamodule always, that of a loader in the middle of an epoch only
    def state_dict(self) -> dict[str, int]:
        return self.train_dataloader().state_dict()

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        self.train_dataloader().load_state_dict(state_dict)


def _moved(augment: Augment | None, device: torch.device) -> Augment | None:
    """An augmentation whose images are held on a device."""
    if not isinstance(augment, Exchange):
        return augment
    words = "the backdrops" if isinstance(augment.stock, Backdrops) else "the photographs"
    return replace(augment, stock=held_on(device, augment.stock, words), then=_moved(augment.then, device))


def held_on(device: torch.device, held: Held, words: str) -> Held:
    """What is held in host memory on a device, if it is a GPU with twice the memory free; otherwise as it is."""
    if device.type == "cpu":
        return held
    free = torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else 0
    if held.n_bytes > free / 2:
        size, room = held.n_bytes / 1e9, free / 2e9
        announce(f"{device}: {words} take {size:.1f} GB, more than the {room:.1f} GB there; they stay in host memory")
        return held
    return held.to(device)

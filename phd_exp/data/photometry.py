"""Other light, colour and image quality: batched formulas of images and of random numbers that the host drew."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import conv2d, pad

from phd_exp.data.jpeg import compressed

NUMBERS = {"tone": 6, "blur": 1, "noise": 1, "place": 1, "jpeg": 1, "occluder": 1, "shape": 2}
"""The random numbers of an image: what each is for, and how many there are."""
VERSION = 5  # of the changes; another version trains on other images, so that an interrupted run cannot be resumed
FIELD = 3 * 512**2  # least number of the standard normal numbers from which the noise of each image is cut
CORNERS = (3, 8)  # least and most of an occluder
ACROSS = (0.08, 0.25)  # radius of an occluder in widths of the image

Images = UInt8[Tensor, "batch height width 3"]


@dataclass(frozen=True)
class Photometry:
    """Random changes of light, colour and image quality, each up to a limit; masks do not follow `occluders`.

    Factors and exponents are uniform between 1/limit and the limit. A quarter of the images each is blurred, gets
    noise, or is compressed, uniformly up to the limit.

    Args:
        occluders: share of the images in which a polygon of one colour hides a part.
        brightness: largest factor of all values; 1 for none.
        contrast: largest factor of the distance from middle grey; 1 for none.
        gamma: largest exponent of values between 0 and 1; 1 for none.
        white_balance: largest factor of each colour channel; 1 for none.
        blur: largest standard deviation of a Gaussian blur, pixels; 0 for none.
        noise: largest standard deviation of white Gaussian noise, levels of 255; 0 for none.
        jpeg: lowest JPEG quality; 100 for none.
    """

    n_numbers: ClassVar[int] = sum(NUMBERS.values())
    occluders: float = 0.0
    brightness: float = 1.0
    contrast: float = 1.0
    gamma: float = 1.0
    white_balance: float = 1.0
    blur: float = 0.0
    noise: float = 0.0
    jpeg: float | int = 100

    @property
    def changes_anything(self) -> bool:
        """Whether any change can be drawn."""
        return self != Photometry()

    def __call__(self, image: Images, numbers: Float[Tensor, "batch n_numbers"]) -> Images:
        """The images, on their device, changed by uniform numbers from -1 to 1 on the host."""
        parts = numbers.double().split(list(NUMBERS.values()), dim=1)
        drawn = {name: part.numpy() for name, part in zip(NUMBERS, parts, strict=True)}
        blur, noise, loss = (_strength(drawn[name][:, 0]) for name in ("blur", "noise", "jpeg"))
        quality = (100 - (100 - self.jpeg) * loss).round().clip(1)
        is_hidden = drawn["occluder"][:, 0] < 2 * self.occluders - 1
        is_toned = (self.brightness, self.contrast, self.gamma, self.white_balance) != (1, 1, 1, 1)
        image = image.clone(memory_format=torch.contiguous_format)
        change(image, is_hidden, occluded, drawn["shape"])
        if is_toned:
            image = toned(image, self._tones(drawn["tone"]))
        change(image, self.blur * blur, blurred, self.blur * blur)
        change(image, self.noise * noise, noisy, self.noise * noise, drawn["place"][:, 0])
        change(image, loss * (self.jpeg < 100), compressed, quality)
        return image

    def fixed(self, image: Images) -> Images:
        """The images, each changed exactly up to every limit; only noise is drawn. Here, limits may be below 1."""
        numbers = torch.ones(len(image), self.n_numbers).split(list(NUMBERS.values()), dim=1)
        drawn = dict(zip(NUMBERS, numbers, strict=True))
        drawn["place"] = 2 * torch.rand(drawn["place"].shape, generator=torch.Generator().manual_seed(0)) - 1
        return self(image, torch.cat(list(drawn.values()), dim=1))

    def _tones(self, numbers: Float[np.ndarray, "batch 6"]) -> UInt8[np.ndarray, "batch bands 256"]:
        """Tables from the levels of each image, or of each of its channels, to their new levels."""
        limits = np.array([self.brightness, self.contrast, self.gamma, *[self.white_balance] * 3])
        factors = 1 / limits + (limits - 1 / limits) * (numbers + 1) / 2
        brightness, contrast, gamma = factors[:, :3, None, None].swapaxes(0, 1)
        gain = brightness * factors[:, 3:, None]
        bands = 1 if self.white_balance == 1 else 3
        value = (gain[:, :bands] * np.arange(256) / 255).clip(0, 1)
        value = (0.5 + contrast * (value - 0.5)).clip(0, 1) ** gamma
        table: UInt8[np.ndarray, "batch bands 256"] = (255 * value).round().astype(np.uint8)
        return table


def change(image: Images, strength: np.ndarray, formula: Callable[..., Images], *numbers: np.ndarray) -> None:
    """Change the images of a strength above zero in place, given their numbers.

    The strengths are on the host, so that nothing waits for the device.
    """
    rows = np.flatnonzero(strength)
    if len(rows):
        place = on(image, rows)
        image[place] = formula(image.index_select(0, place), *(values[rows] for values in numbers))


def on(image: Tensor, numbers: np.ndarray) -> Tensor:
    """Numbers of the host on the device of the images, floating-point ones as float32."""
    values = torch.from_numpy(numbers)
    return (values.float() if values.is_floating_point() else values).to(image.device, non_blocking=True)


def levels(values: Tensor) -> UInt8[Tensor, "..."]:
    """Values rounded to levels, in place."""
    return values.round_().clamp_(0, 255).to(torch.uint8)


def toned(image: Images, tables: UInt8[np.ndarray, "batch bands 256"]) -> Images:
    """tables[image], one for each image, or for each of its channels."""
    batch, bands, _ = tables.shape
    first = 256 * (np.arange(batch, dtype=np.int32)[:, None] * bands + np.arange(3, dtype=np.int32) % bands)
    place = image + on(image, first)[:, None, None]
    return on(image, tables).flatten().index_select(0, place.flatten()).view_as(image)


def blurred(image: Images, deviation: NDArray[np.float64]) -> Images:
    """The convolution with a Gaussian, up to three times its standard deviation; the border is repeated."""
    reach = np.ceil(3 * deviation)[:, None]
    side = int(reach.max())
    place = np.abs(np.arange(-side, side + 1))
    weight = np.exp(-(place**2) / (2 * deviation[:, None] ** 2)) * (place <= reach)
    weights = on(image, weight / weight.sum(1, keepdims=True)).repeat_interleave(3, 0)[:, None, :, None]
    planes = image.permute(0, 3, 1, 2).flatten(0, 1)[None].float()
    for kernel in (weights, weights.mT):
        edges = (side, side, 0, 0) if kernel is not weights else (0, 0, side, side)
        planes = conv2d(pad(planes, edges, mode="replicate"), kernel, groups=len(kernel))
    return levels(planes).view(-1, 3, *image.shape[1:3]).permute(0, 2, 3, 1).contiguous()


def noisy(image: Images, deviation: NDArray[np.float64], place: NDArray[np.float64]) -> Images:
    """The images with noise of that standard deviation from a place (-1 to 1) of the field."""
    n = image[0].numel()
    field = _field(max(FIELD, 4 * n), image.device)
    starts = ((len(field) - n) * (place + 1) / 2).astype(np.int64)
    noise = field.unfold(0, n, 1).index_select(0, on(image, starts)).view(image.shape)
    return levels(noise.mul_(on(image, deviation)[:, None, None, None]).add_(image))


@cache
def _field(n: int, device: torch.device) -> Float[Tensor, " n"]:
    """Standard normal numbers."""
    return torch.from_numpy(np.random.default_rng(0).standard_normal(n, dtype=np.float32)).to(device)


def occluded(image: Images, shape: NDArray[np.float64]) -> Images:
    """The images behind a convex polygon of one colour anywhere in each, 16 to 50 % of its width across.

    Its corners lie on a circle; it is the intersection of the half planes inside the chords between neighbours.
    """
    _, height, width, _ = image.shape
    x, y, radius, corners, *others = many(shape, 7 + CORNERS[1]).T
    radius = width * (ACROSS[0] + (ACROSS[1] - ACROSS[0]) * radius)
    angle, colour = 2 * np.pi * np.array(others[3:]).T, (256 * np.array(others[:3])).astype(np.uint8).T
    used = np.arange(CORNERS[1]) < CORNERS[0] + ((CORNERS[1] - CORNERS[0] + 1) * corners).astype(int)[:, None]
    angle = np.sort(np.where(used, angle, angle[:, :1]), axis=1)  # a repeated corner changes nothing
    following = np.concatenate([angle[:, 1:], angle[:, :1] + 2 * np.pi], axis=1)
    middle, half = (angle + following) / 2, (following - angle) / 2
    normal = np.stack([np.cos(middle), np.sin(middle)])
    centre = np.stack([width * x, height * y])[..., None]
    bound = radius[:, None] * np.cos(half) + (normal * centre).sum(0)
    across, down = (torch.arange(n, device=image.device) + 0.5 for n in (width, height))
    (a, b), c = (on(image, part)[..., None, None] for part in normal), on(image, bound)[..., None, None]
    hidden = (a * across + b * down[:, None] <= c).all(1)
    return torch.where(hidden[..., None], on(image, colour)[:, None, None], image)


def many(few: Float[np.ndarray, "batch 2"], n: int) -> Float[np.ndarray, "batch n"]:
    """n numbers from 0 to 1, given two: fractional parts of large multiples."""
    multiples = 1e4 * np.sqrt(np.arange(2, 2 + n) + 0.5)
    return np.asarray((few[:, :1] * multiples + few[:, 1:] * multiples[::-1]) % 1)


def _strength(number: NDArray[np.float64]) -> NDArray[np.float64]:
    """Uniform numbers from -1 to 1 -> 0 for three quarters of them, else uniform from 0 to 1."""
    return np.maximum(0.0, 4 * np.abs(number) - 3)

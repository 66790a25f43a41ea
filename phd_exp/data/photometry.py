"""Other light, colour and image quality: batched formulas of images and of random numbers that the host drew."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

from phd_exp.data.jpeg import compressed

NUMBERS = {"tone": 6, "blur": 1, "noise": 1, "place": 1, "jpeg": 1, "occluder": 1, "shape": 2}
"""The random numbers of an image: what each is for, and how many there are."""
VERSION = 4  # of the changes; another version trains on other images, so that an interrupted run cannot be resumed
CACHED = 640 * 1024  # bytes of images whose intermediate values fit in a CPU's cache
LEVELS = 256
FIELD = 512  # side of the field of standard normal numbers from which the noise of each image is cut, pixels
FINE, FARTHEST = 64, 5.0  # these numbers are multiples of 1/FINE up to FARTHEST
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
        if is_hidden.any() or not is_toned:  # changed in place
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

    The strengths are on the host, so that nothing waits for the device. Images of like strength are changed together.
    They are written in words of 16 bytes if the size allows it, since a CPU copies element by element.
    """
    word = torch.uint8 if image[0].numel() % 16 else torch.complex128
    words = image.view(len(image), -1).view(word)
    rows = np.flatnonzero(strength)
    rows = rows[strength[rows].argsort(kind="stable")]
    for block in blocks(image, len(rows)):
        chosen = on(image, rows[block])
        part = formula(image.index_select(0, chosen), *(values[rows[block]] for values in numbers))
        words.index_copy_(0, chosen, part.flatten(1).view(word))


def blocks(image: Tensor, n: int, n_bytes: int = CACHED) -> list[slice]:
    """Slices of n images that are changed together: a CPU's cache holds few of them, a GPU takes all at once."""
    step = max(1, n_bytes // image[0].numel() if image.device.type == "cpu" else n)
    return [slice(start, start + step) for start in range(0, n, step)]


def on(image: Tensor, numbers: np.ndarray) -> Tensor:
    """Numbers of the host on the device of the images, floating-point ones as float32."""
    values = torch.from_numpy(numbers)
    return (values.float() if values.is_floating_point() else values).to(image.device, non_blocking=True)


def levels(values: Tensor) -> UInt8[Tensor, "..."]:
    """Values rounded to levels, in place; a CPU converts them faster by way of int16."""
    return values.round_().clamp_(0, 255).to(torch.int16).to(torch.uint8)


def toned(image: Images, tables: UInt8[np.ndarray, "batch bands 256"]) -> Images:
    """tables[image], two bytes at a time: look-ups take most of the time, of one byte as of two."""
    n, (batch, bands, _) = image[0].numel(), tables.shape
    order = np.array([[0, 2, 1], [1, 0, 2]])[:, :bands] % bands  # bands of the first and second bytes of pairs
    first, second = (on(image, tables[:, of_bytes].astype(np.int16)) for of_bytes in order)
    whole = image.flatten(1)
    if n % 6:  # make it a whole number of pairs of each of the three kinds
        whole = pad(whole, (0, -n % 6))
    result = torch.empty_like(whole)
    for block in blocks(image, batch, CACHED // 5):
        pairs = (second[block, :, :, None].mul(LEVELS) + first[block, :, None]).flatten()
        places = whole[block].view(torch.uint16).int()
        starts = on(image, LEVELS**2 * np.arange(len(pairs) // LEVELS**2, dtype=np.int32))
        if len(starts) > 1:
            places = places.view(-1, places.shape[1] // bands, bands).add_(starts.view(-1, 1, bands))
        torch.index_select(pairs, 0, places.flatten(), out=result[block].view(torch.int16).view(-1))
    return result[:, :n].reshape(image.shape)


def blurred(image: Images, deviation: NDArray[np.float64]) -> Images:
    """The convolution with a Gaussian, up to three times its standard deviation; the border is repeated.

    Weights are multiples of 1/256, so that 16 bits hold all sums of the levels less 128, in half the time of float32.
    """
    reach = np.ceil(3 * deviation)[:, None]
    place = np.arange(int(reach.max()) + 1)
    weight = np.exp(-(place**2) / (2 * deviation[:, None] ** 2)) * (place <= reach)
    weight = (256 * weight / (2 * weight.sum(1, keepdims=True) - weight[:, :1])).round()
    weight[:, 0] = 256 - 2 * weight[:, 1:].sum(1)
    weights = on(image, weight.T.astype(np.int16))[..., None, None, None]
    height, width = image.shape[1:3]
    rows = _smooth(image.to(torch.int16).sub_(128), weights)
    return _smooth(rows.view(-1, 1, height, 3 * width), weights).add_(128).to(torch.uint8).view_as(image)


def _smooth(
    values: Int[Tensor, "batch others places inner"], weights: Int[Tensor, "reach batch 1 1 1"]
) -> Int[Tensor, "batch others places inner"]:
    """(weights[0] v[i] + sum over k of weights[k] (v[i - k] + v[i + k])) / 256, rounded."""
    reach, n = len(weights) - 1, values.shape[2]
    first, last = values[:, :, :1], values[:, :, -1:]
    around = torch.cat([*[first] * reach, values, *[last] * reach], dim=2)  # `pad` takes as long as all the sums
    total, pair = weights[0] * values, torch.empty_like(values)
    for k in range(1, reach + 1):
        torch.add(around.narrow(2, reach - k, n), around.narrow(2, reach + k, n), out=pair)
        total.addcmul_(weights[k], pair)
    return total.add_(128).bitwise_right_shift_(8)


def noisy(image: Images, deviation: NDArray[np.float64], place: NDArray[np.float64]) -> Images:
    """The images with noise of that standard deviation from a place (-1 to 1) of the field.

    It is the product of two integers, divided by the largest power of two for which 16 bits hold all products: this
    takes two thirds of the time of float32, and differs by at most a level.
    """
    n = image[0].numel()
    field = _field(max(3 * FIELD**2, 4 * n), image.device)
    starts = ((len(field) - n) * (place + 1) / 2).astype(np.int64)
    bits = min(14, int(np.log2(2**15 / (1.1 * FARTHEST * deviation.max() + 1))))
    factor = on(image, (2**bits / FINE * deviation).round().astype(np.int16))
    noise = field.unfold(0, n, 1).index_select(0, on(image, starts)).mul_(factor[:, None])
    noise.add_(1 << (bits - 1)).bitwise_right_shift_(bits).add_(image.flatten(1))
    return noise.clamp_(0, 255).to(torch.uint8).view_as(image)


@cache
def _field(n: int, device: torch.device) -> Int[Tensor, " n"]:
    """Standard normal numbers in units of 1 / `FINE`."""
    values = np.random.default_rng(0).standard_normal(n, dtype=np.float32).clip(-FARTHEST, FARTHEST)
    return torch.from_numpy((FINE * values).round().astype(np.int16)).to(device)


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

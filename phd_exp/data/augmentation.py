"""Augmentation: the same scenes through other cameras and in other light, with exact labels."""

import io
from dataclasses import dataclass, replace
from functools import cache
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFilter
from torch import Tensor
from torch.nn.functional import grid_sample

from phd_exp.data.batches import SIGNS, Batch
from phd_exp.geometry.camera import middles
from phd_exp.geometry.motion import Motion, small_turns, symmetries, turned

FIELD = 512  # side of the field of standard normal numbers from which the noise of each image is cut, pixels
NUMBERS = (6, 1, 1, 2, 1, 1, 1)  # of Photometry: tone, blur, noise, its place in the field, JPEG, occluder, its shape
TURN, COLOURS = 4, 3  # of Augmentation: numbers of a rotation and zoom, and of an order of the channels


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

    n_numbers: ClassVar[int] = sum(NUMBERS)
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

    def __call__(
        self, image: UInt8[Tensor, "batch height width 3"], numbers: Float[Tensor, "batch n_numbers"]
    ) -> UInt8[Tensor, "batch height width 3"]:
        """The images, changed by uniform numbers from -1 to 1."""
        result = [self._changed(one, row) for one, row in zip(image.numpy(), numbers.tolist(), strict=True)]
        return torch.from_numpy(np.stack(result))

    def fixed(self, image: UInt8[Tensor, "batch height width 3"]) -> UInt8[Tensor, "batch height width 3"]:
        """The images, each changed exactly up to every limit; only noise is drawn. Here, limits may be below 1."""
        tone, blur, noise, place, *others = torch.ones(len(image), self.n_numbers).split(NUMBERS, dim=1)
        place = 2 * torch.rand(place.shape, generator=torch.Generator().manual_seed(0)) - 1
        return self(image, torch.cat([tone, blur, noise, place, *others], dim=1))

    def _changed(self, image: NDArray[np.uint8], numbers: list[float]) -> NDArray[np.uint8]:
        *tone, blur, noise, top, left, loss, occluder, shape = numbers
        picture = Image.fromarray(image)
        if occluder < 2 * self.occluders - 1:
            _hide_a_part(picture, seed=int(2**32 * (shape + 1)))
        if (self.brightness, self.contrast, self.gamma, self.white_balance) != (1, 1, 1, 1):
            picture = picture.point(self._tone(tone))
        if self.blur and (blur := _strength(blur)):
            picture = picture.filter(ImageFilter.GaussianBlur(self.blur * blur))
        if self.noise and (noise := _strength(noise)):
            picture = Image.fromarray(_noisy(np.asarray(picture), self.noise * noise, [top, left]))
        if self.jpeg < 100 and (loss := _strength(loss)):
            compressed = io.BytesIO()
            picture.save(compressed, format="jpeg", quality=round(100 - (100 - self.jpeg) * loss))
            picture = Image.open(compressed)
        return np.asarray(picture)

    def _tone(self, numbers: list[float]) -> list[int]:
        """Table from the 256 levels of each of the three channels to their new levels."""
        limits = (self.brightness, self.contrast, self.gamma, *[self.white_balance] * 3)
        brightness, contrast, gamma, *balance = map(_factor, limits, numbers)
        gain = brightness * np.array(balance)
        value = (gain[:, None] * np.arange(256) / 255).clip(0, 1)
        value = (0.5 + contrast * (value - 0.5)).clip(0, 1) ** gamma
        table: list[int] = (255 * value).round().astype(int).ravel().tolist()
        return table


def _factor(limit: float, number: float) -> float:
    """Uniform numbers from -1 to 1 -> uniform from 1/limit to the limit."""
    return 1 / limit + (limit - 1 / limit) * (number + 1) / 2


def _strength(number: float) -> float:
    """Uniform numbers from -1 to 1 -> 0 for three quarters of them, else uniform from 0 to 1."""
    return max(0.0, 4 * abs(number) - 3)


def _hide_a_part(picture: Image.Image, seed: int) -> None:
    """Draw a convex polygon of one colour anywhere in the picture, 16 to 50 % of its width across."""
    draw = np.random.default_rng(seed)
    centre, radius = draw.uniform(0, 1, 2) * picture.size, draw.uniform(0.08, 0.25) * picture.width
    angle = np.sort(draw.uniform(0, 2 * np.pi, draw.integers(3, 9)))
    corners = centre + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    ImageDraw.Draw(picture).polygon(corners.ravel().tolist(), fill=tuple(draw.integers(0, 256, 3).tolist()))


def _noisy(image: NDArray[np.uint8], deviation: float, place: list[float]) -> NDArray[np.uint8]:
    """The image with noise from a position (-1 to 1) of the field."""
    height, width = image.shape[:2]
    field = _field(max(FIELD, 2 * height, 2 * width))
    top, left = (
        int((len(field) - side) * (number + 1) / 2) for side, number in zip((height, width), place, strict=True)
    )
    noise = field[top : top + height, left : left + width]
    return (image + deviation * noise).round().clip(0, 255).astype(np.uint8)


@cache
def _field(side: int) -> NDArray[np.float32]:
    return np.random.default_rng(0).standard_normal((side, side, 3), dtype=np.float32)


@dataclass(frozen=True)
class Augmentation:
    """Random changes of the samples of a batch.

    Args:
        symmetries: apply one of the eight rotations and reflections that map pixels to pixels.
        largest_zoom: largest factor of a small rotation and zoom of the camera; 1 for none.
        colours: permute the three colour channels.
        photometry: changes of light and image quality.
    """

    n_numbers: ClassVar[int] = SIGNS + TURN + COLOURS + Photometry.n_numbers
    symmetries: bool
    largest_zoom: float
    colours: bool
    photometry: Photometry

    @property
    def changes_anything(self) -> bool:
        """Whether any change can be drawn."""
        return self.symmetries or self.largest_zoom > 1 or self.colours or self.photometry.changes_anything

    def __call__(self, batch: Batch, numbers: Float[Tensor, "batch n_numbers"]) -> Batch:
        """The samples, changed by uniform numbers from -1 to 1.

        A rotation and zoom that would move the object out of the image is skipped; the symmetry is kept.
        """
        *of_camera, of_light = numbers.split([SIGNS, TURN, COLOURS, Photometry.n_numbers], dim=1)
        if self.photometry.changes_anything:
            batch = replace(batch, image=self.photometry(batch.image, of_light))
        signs, turn, order = (part.to(batch.f) for part in of_camera)
        camera = batch.camera
        signs = signs if self.symmetries else torch.ones_like(signs)
        colours = order.argsort(dim=-1) if self.colours else torch.arange(COLOURS).expand_as(order)
        symmetry = symmetries(signs)
        if self.largest_zoom > 1:
            motion = small_turns(turn, self.largest_zoom, camera).after(symmetry)
            motion = motion.where(motion.camera(camera).contains(motion.position(batch.xyz)), symmetry)
            batch, signs = moved(batch, motion), torch.ones_like(signs)
        else:
            batch = replace(batch, xyz=symmetry.position(batch.xyz))
        image, mask = _rearranged(batch.image, signs, colours), batch.mask
        if mask is not None:
            mask = _rearranged(mask[..., None], signs, colours[:, :1] * 0)[..., 0]
        return replace(batch, image=image, mask=mask)


def _rearranged(
    image: UInt8[Tensor, "batch side side channels"],
    signs: Float[Tensor, "batch 3"],
    colours: Int[Tensor, "batch channels"],
) -> UInt8[Tensor, "batch side side channels"]:
    """The images `moved` by `symmetries` of these signs, without interpolation; with the channels in that order.

    One image at a time: indexing the batch once per reflection is ten times slower.
    """
    turns = (turned(one, row) for one, row in zip(image, signs.tolist(), strict=True))
    orders = zip(turns, colours.tolist(), strict=True)
    return torch.stack([torch.stack([pixels[..., old] for old in order], dim=-1) for pixels, order in orders])


def moved(batch: Batch, motion: Motion) -> Batch:
    """The samples after a motion of the cameras: images interpolated bilinearly, the border repeated beyond it."""

    def resampled(images: UInt8[Tensor, "batch side side channels"]) -> UInt8[Tensor, "batch side side channels"]:
        side = images.shape[1]
        origin = motion.origin(middles(side, side).to(batch.f), batch.camera)
        values = grid_sample(
            images.permute(0, 3, 1, 2).to(origin.dtype), origin, padding_mode="border", align_corners=False
        )
        return values.round().to(torch.uint8).permute(0, 2, 3, 1)

    mask = None if batch.mask is None else resampled(batch.mask[..., None])[..., 0]
    return replace(
        batch,
        image=resampled(batch.image),
        xyz=motion.position(batch.xyz),
        f=motion.camera(batch.camera).f,
        mask=mask,
    )

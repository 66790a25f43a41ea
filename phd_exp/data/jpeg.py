"""JPEG compression of a batch of images: what a baseline encoder with 4:2:0 chroma and a decoder lose."""

import math

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import interpolate, pad

BLOCK, UNIT = 8, 16  # pixels along the sides of a block of the cosine transform, and of the unit with shared chroma
TWO_UNITS = 2 * UNIT  # images are padded to whole pairs, so that chroma also consists of whole units
# fmt: off
LUMA = (
    16, 11, 10, 16, 24, 40, 51, 61, 12, 12, 14, 19, 26, 58, 60, 55,
    14, 13, 16, 24, 40, 57, 69, 56, 14, 17, 22, 29, 51, 87, 80, 62,
    18, 22, 37, 56, 68, 109, 103, 77, 24, 35, 55, 64, 81, 104, 113, 92,
    49, 64, 78, 87, 103, 121, 120, 101, 72, 92, 95, 98, 112, 100, 103, 99,
)
CHROMA = (
    17, 18, 24, 47, 99, 99, 99, 99, 18, 21, 26, 66, 99, 99, 99, 99,
    24, 26, 56, 99, 99, 99, 99, 99, 47, 66, 99, 99, 99, 99, 99, 99,
    *[99] * 32,
)
"""Steps of quantisation at quality 50, row by row. Source: ITU-T T.81, tables K.1 and K.2."""
# fmt: on
TO_YCC = ((0.299, 0.587, 0.114), (-0.168736, -0.331264, 0.5), (0.5, -0.418688, -0.081312))
"""R, G, B -> luma, blue and red chroma. Source: ITU-T T.871."""


def compressed(
    image: UInt8[Tensor, "batch height width 3"], quality: NDArray[np.float64]
) -> UInt8[Tensor, "batch height width 3"]:
    """The images after compression with a whole quality each, from 1 to 100.

    Chroma has half the resolution: means of 2 x 2 pixels, interpolated linearly. Only sums are not rounded as an
    encoder and a decoder of integers do, which changes values by a fraction of a level.
    """
    height, width = image.shape[1:3]
    rgb = image.permute(0, 3, 1, 2).float().contiguous()
    below, beside = -height % TWO_UNITS, -width % TWO_UNITS
    rgb = pad(rgb, (0, beside, 0, below), mode="replicate") if below or beside else rgb
    ycc = (rgb.new_tensor(TO_YCC) @ rgb.flatten(2)).unflatten(2, rgb.shape[2:]).round_()
    luma = _lossy(ycc[:, :1].sub_(128), _steps(LUMA, quality))
    chroma = _lossy(_halved(ycc[:, 1:]), _steps(CHROMA, quality))
    result = _to_rgb(luma[:, 0].add_(128), *_doubled(chroma).unbind(1))
    return result[:, :height, :width] if below or beside else result


def _lossy(
    planes: Float[Tensor, "batch planes height width"], steps: Float[Tensor, "batch 8 8"]
) -> Float[Tensor, "batch planes height width"]:
    """The planes, with the cosine transform of each block rounded to multiples of the steps."""
    cosines = torch.block_diag(*[_cosines()] * 2).to(planes.device)  # of two blocks, three times as fast as of one
    steps = steps.to(planes.device).repeat(1, 1, planes.shape[-1] // BLOCK)[:, None, None]
    values = _along_both(planes, cosines).unflatten(2, (-1, BLOCK))
    return _along_both((values / steps).round_().mul_(steps).flatten(2, 3), cosines.T).round_()


def _halved(planes: Float[Tensor, "batch planes height width"]) -> Float[Tensor, "batch planes rows columns"]:
    """Means of 2 x 2 pixels; halves are rounded down and up in alternating columns."""
    pairs = planes[:, :, ::2] + planes[:, :, 1::2]
    bias = (1 + torch.arange(pairs.shape[-1] // 2, device=planes.device) % 2) / 4
    return (pairs[..., ::2] + pairs[..., 1::2]).div_(4).add_(bias).floor_()


def _doubled(planes: Float[Tensor, "batch planes rows columns"]) -> Float[Tensor, "batch planes height width"]:
    """The planes interpolated linearly at twice as many pixels; halves are rounded up and down."""
    fine = interpolate(planes, scale_factor=2.0, mode="bilinear")
    return fine.add_((8 - torch.arange(fine.shape[-1], device=planes.device) % 2) / 16).floor_()


def _along_both(
    planes: Float[Tensor, "batch planes height width"], matrix: Float[Tensor, "out unit"]
) -> Float[Tensor, "batch planes rows columns"]:
    """The planes with the matrix applied to every unit of rows, and then to every unit of columns."""
    down = (matrix @ planes.unflatten(2, (-1, matrix.shape[1]))).flatten(2, 3)
    return (down.reshape(-1, matrix.shape[1]) @ matrix.T).view(*down.shape[:3], -1)


def _to_rgb(
    y: Float[Tensor, "batch height width"], blue: Float[Tensor, "batch height width"], red: Tensor
) -> UInt8[Tensor, "batch height width 3"]:
    """Luma and chroma -> rounded colours. Channel by channel: four times as fast as rounding them together."""
    green = y.sub(blue, alpha=0.344136).sub_(red, alpha=0.714136)
    colours = (y.add(red, alpha=1.402), green, y.add(blue, alpha=1.772))
    result = torch.empty(*y.shape, 3, dtype=torch.uint8, device=y.device)
    for channel, values in enumerate(colours):
        result[..., channel] = values.round_().clamp_(0, 255)
    return result


def _cosines() -> Float[Tensor, "8 8"]:
    """The orthonormal cosine transform of eight numbers: frequencies by places."""
    frequency, place = torch.meshgrid(torch.arange(BLOCK), torch.arange(BLOCK), indexing="ij")
    waves = (math.pi * frequency * (2 * place + 1) / (2 * BLOCK)).cos() / math.sqrt(BLOCK / 2)
    waves[0] /= math.sqrt(2)
    return waves


def _steps(at_50: tuple[int, ...], quality: NDArray[np.float64]) -> Float[Tensor, "batch 8 8"]:
    """The steps of quantisation of each image. Source: the reference encoder of the Independent JPEG Group."""
    percent = np.where(quality < 50, 5000 // quality, 200 - 2 * quality)
    steps = np.clip((np.array(at_50) * percent[:, None] + 50) // 100, 1, 255)
    return torch.from_numpy(steps).float().view(-1, BLOCK, BLOCK)

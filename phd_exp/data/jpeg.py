"""JPEG compression of a batch of images: what a baseline encoder with 4:2:0 chroma and a decoder lose."""

import math
from functools import cache

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

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
MIDDLE = 128  # subtracted from luma before the cosine transform


def compressed(
    image: UInt8[Tensor, "batch height width 3"], quality: NDArray[np.float64]
) -> UInt8[Tensor, "batch height width 3"]:
    """The images after compression with a whole quality each, from 1 to 100.

    Chroma has half the resolution: means of 2 x 2 pixels, interpolated linearly. Only sums are not rounded as an
    encoder and a decoder of integers do, which changes values by a fraction of a level.
    """
    height, width = image.shape[1:3]
    below, beside = -height % TWO_UNITS, -width % TWO_UNITS
    rgb = image.permute(3, 0, 1, 2).to(torch.float32, memory_format=torch.contiguous_format)
    rgb = pad(rgb, (0, beside, 0, below), mode="replicate") if below or beside else rgb
    ycc = _to_ycc(rgb)
    luma = _lossy(ycc[0].sub_(MIDDLE), _steps(LUMA, quality))
    chroma = _lossy(_halved(ycc[1:]), _steps(CHROMA, quality))
    result = _to_rgb(luma, chroma)
    return result[:, :height, :width] if below or beside else result


def _to_ycc(rgb: Float[Tensor, "3 batch height width"]) -> Float[Tensor, "3 batch height width"]:
    """Luma and chroma, rounded. Plane by plane: on a CPU, a product of matrices takes three times as long."""
    ycc = torch.empty_like(rgb)
    for plane, (red, green, blue) in zip(ycc, TO_YCC, strict=True):
        torch.mul(rgb[0], red, out=plane).add_(rgb[1], alpha=green).add_(rgb[2], alpha=blue)
    return ycc.round_()


def _lossy(
    planes: Float[Tensor, "*planes batch height width"], steps: Float[np.ndarray, "batch 8 8"]
) -> Float[Tensor, "*planes batch height width"]:
    """The planes, with the cosine transform of each block rounded to multiples of the steps."""
    one, two = _cosines(planes.device)
    tiled = np.tile(steps, (1, 1, planes.shape[-1] // BLOCK))[:, None]
    of_rows = torch.from_numpy(tiled).to(planes.device, non_blocking=True)
    down = one @ planes.unflatten(-2, (-1, BLOCK))
    rounded = (down.view(-1, UNIT) @ two.T).view(down.shape).div_(of_rows).round_().mul_(of_rows)
    return ((one.T @ rounded).view(-1, UNIT) @ two).view(planes.shape).round_()


def _halved(planes: Float[Tensor, "*planes height width"]) -> Float[Tensor, "*planes rows columns"]:
    """Means of 2 x 2 pixels; halves are rounded down and up in alternating columns."""
    pairs = planes[..., ::2, :] + planes[..., 1::2, :]
    bias = (1 + torch.arange(pairs.shape[-1] // 2, device=planes.device) % 2) / 4
    return (pairs[..., ::2] + pairs[..., 1::2]).div_(4).add_(bias).floor_()


def _to_rgb(
    luma: Float[Tensor, "batch height width"], chroma: Float[Tensor, "2 batch rows columns"]
) -> UInt8[Tensor, "batch height width 3"]:
    """Rounded colours, given luma less `MIDDLE` and chroma of half the resolution, which is interpolated linearly.

    Even and odd columns are computed separately, so that no plane of interpolated columns is stored. So are channels,
    because rounding them together takes longer.
    """
    edged = pad(chroma, (1, 1, 1, 1), mode="replicate")
    here = edged[:, :, 1:-1]
    fine = torch.stack([torch.lerp(here, near, 0.25) for near in (edged[:, :, :-2], edged[:, :, 2:])], dim=3)
    fine = fine.flatten(2, 3)
    result = torch.empty(*luma.shape, 3, dtype=torch.uint8, device=luma.device)
    for first, near in ((0, fine[..., :-2]), (1, fine[..., 2:])):
        blue, red = torch.lerp(fine[..., 1:-1], near, 0.25).add_((8 - first) / 16).floor_()
        y = luma[..., first::2] + (MIDDLE + 0.5)  # the conversion to integers rounds down
        green = y.sub(blue, alpha=0.344136).sub_(red, alpha=0.714136)
        colours = (y.add(red, alpha=1.402), green, y.add(blue, alpha=1.772))
        for channel, values in enumerate(colours):
            result[:, :, first::2, channel] = values.clamp_(0, 255)
    return result


@cache
def _cosines(device: torch.device) -> tuple[Float[Tensor, "8 8"], Float[Tensor, "16 16"]]:
    """The orthonormal cosine transform of one block, frequencies by places, and of two: faster from the right."""
    frequency, place = torch.meshgrid(torch.arange(BLOCK), torch.arange(BLOCK), indexing="ij")
    waves = (math.pi * frequency * (2 * place + 1) / (2 * BLOCK)).cos() / math.sqrt(BLOCK / 2)
    waves[0] /= math.sqrt(2)
    return waves.to(device), torch.block_diag(waves, waves).to(device)


def _steps(at_50: tuple[int, ...], quality: NDArray[np.float64]) -> Float[np.ndarray, "batch 8 8"]:
    """The steps of quantisation of each image. Source: the reference encoder of the Independent JPEG Group."""
    percent = np.where(quality < 50, 5000 // quality, 200 - 2 * quality)
    steps = np.clip((np.array(at_50) * percent[:, None] + 50) // 100, 1, 255)
    return steps.astype(np.float32).reshape(-1, BLOCK, BLOCK)

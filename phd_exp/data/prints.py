"""Prints on the objects of training images: a network must not take the edges of a print for those of the object."""

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from phd_exp.data.areas import GREY
from phd_exp.data.backdrops import Backdrops, tiled
from phd_exp.data.batches import Batch
from phd_exp.data.photometry import change, levels, on

PRINT_NUMBERS = 14  # per sample: whether it changes, and those of `printed`
LARGEST = math.log(4)  # largest log factor by which a print changes values
DETAIL = 2.0  # standard deviations from the mean of a backdrop at which its print is lightest or darkest
SOFTEST = 8.0  # levels: backdrops with a smaller standard deviation have fainter prints


def printed(
    backdrops: Backdrops, batch: Batch, chosen: Bool[np.ndarray, " batch"], numbers: Float[np.ndarray, "batch 13"]
) -> Batch:
    """The batch, with a print on the objects of some samples: image * exp(covered * log factor).

    Two random lines divide the image into four pieces, as edges divide an object into faces. The log factor is the
    sum of a constant for each piece and the texture of a random backdrop, `tiled`, and mirrored on one side of the
    first line. Values are multiplied, so that shading remains. Pixels beyond the edges of the user's image stay grey.

    Source: own design, after the random textures of Tobin et al., "Domain randomization" (2017).

    Args:
        backdrops: of all training samples.
        batch: some of these samples.
        chosen: which of them to change.
        numbers: from 0 to 1; one chooses the backdrop, four its view, one the strength of the print, four the lines,
            three the pieces.
    """

    def changed(
        image: UInt8[Tensor, "some side side 3"], place: Int[np.ndarray, " some"], drawn: Float[np.ndarray, "some 13"]
    ) -> UInt8[Tensor, "some side side 3"]:
        empty = backdrops.empty
        behind, clear = backdrops.of(batch, place)
        is_grey = ((image == GREY) & (behind == GREY)).all(-1)
        covered = torch.where(is_grey, 0.0, 1 - clear.float() / 255)[..., None]
        texture = tiled(empty, (len(empty) * drawn[:, 0]).astype(np.int64), drawn[:, 1:5]).to(image.device)
        factor = _log_factor(texture.float().mean(-1, keepdim=True), drawn[:, 6:10], 2 * drawn[:, 10:] - 1)
        strength = on(image, LARGEST * drawn[:, 5])[:, None, None, None]
        return levels(image.float().mul_(factor.mul_(strength).mul_(covered).exp_()))

    image = batch.image.clone(memory_format=torch.contiguous_format)
    change(image, chosen, changed, np.arange(len(batch)), numbers)
    return replace(batch, image=image)


def _log_factor(
    texture: Float[Tensor, "some side side 1"],
    lines: Float[np.ndarray, "some 4"],
    pieces: Float[np.ndarray, "some 3"],
) -> Float[Tensor, "some side side 1"]:
    """The log factors of prints of these textures, from -1 to 1.

    Args:
        texture: mean of the colours of a backdrop.
        lines: from 0 to 1: x and y of the point where both lines cross, in the middle half of each axis, and the
            direction of each over pi.
        pieces: from -1 to 1: weights of the side of each line (-1 or 1), and of the product of both sides.
    """
    side = texture.shape[1]
    x, y, *angles = lines.T
    axis = torch.arange(side, device=texture.device) + 0.5
    across, down = (axis - on(texture, side * (0.25 + 0.5 * place))[:, None] for place in (x, y))
    first, second = (
        (on(texture, np.cos(math.pi * angle))[:, None, None] * across[:, None, :]
         + on(texture, np.sin(math.pi * angle))[:, None, None] * down[:, :, None])[..., None].sign()
        for angle in angles
    )  # fmt: skip
    detail = torch.where(first > 0, texture, texture.flip(1))
    deviation, mean = torch.std_mean(detail, (1, 2, 3), keepdim=True, correction=0)
    detail = ((detail - mean) / (DETAIL * deviation.clamp_min(SOFTEST))).clamp_(-1, 1)
    a, b, c = (on(texture, part)[:, None, None, None] for part in pieces.T)
    return (detail + a * first + b * second + c * first * second).div_(2).clamp_(-1, 1)

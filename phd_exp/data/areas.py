"""Views of an image whose pixels are means over areas: plain functions of torch, which exported graphs share."""

from collections.abc import Callable

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn.functional import grid_sample, pad

GREY = 128  # all colours of transparent pixels and of those beyond the edges of an image
TIES = 1e6  # means are rounded to 1/TIES first, so that halves are exact whatever the order of the sums

BEYOND = 3.0  # a place outside every image, in units of half its size from the middle


def sums(image: UInt8[Tensor, "height width bands"]) -> Float[Tensor, "height+1 width+1 bands"]:
    """Exact sums of an image, less grey, over the rectangle from its top left corner to every corner of a pixel."""
    table = pad(image, (0, 0, 1, 0, 1, 0), value=GREY).double().sub_(GREY)
    return table.cumsum_(0).cumsum_(1)


def area_means(
    table: Float[Tensor, "bottom right bands"], corners: Float[Tensor, "*views lower further 2"]
) -> UInt8[Tensor, "*views rows columns bands"]:
    """The views whose pixels have their corners at these places (column, row) of an image, given its `sums`.

    Each pixel is the mean over an upright rectangle about the middle of its corners. The rectangle has the extent of
    the pixel along both axes (the root of the sum of squares of its two edges), and at least that of a pixel of the
    image, so that views of more pixels are interpolated linearly. Beyond the image, and at NaN, all is grey.
    """
    return _means(corners, lambda x, y: _at(table, x, y))


def _means(corners: Tensor, at: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """`area_means`, given the sums up to the places (x, y)."""
    middle, side = _rectangles(corners)
    side = side.clamp_min(1)
    (left, top), (right, bottom) = ((middle + sign * side / 2).unbind(-1) for sign in (-1, 1))
    total = at(right, bottom) - at(left, bottom) - at(right, top) + at(left, top)
    mean = (GREY + total / side.prod(-1, keepdim=True)).nan_to_num(float(GREY))  # where a corner is NaN
    return _rounded(mean)


def view(
    image: UInt8[Tensor, "height width bands"], corners: Float[Tensor, "lower further 2"]
) -> UInt8[Tensor, "rows columns bands"]:
    """The view of an image whose pixels have their corners at these places: `area_means`, in less time.

    If no pixel is larger than those of the image, the means are bilinear interpolations, which need a quarter of the
    look-ups and no sums. All are computed in float64 and differ in its rounding alone.
    """
    middle, side = _rectangles(corners)
    if side.nan_to_num(0.0).max() > 1:
        bands = sums(image).permute(2, 0, 1).contiguous()
        return _means(corners, lambda x, y: _sampled(bands, x, y))
    size = middle.new_tensor([image.shape[1], image.shape[0]])
    place = (2 * middle / size - 1).nan_to_num(BEYOND).clamp(-BEYOND, BEYOND)
    values = image.permute(2, 0, 1)[None].to(middle.dtype).sub_(GREY)  # zero beyond the edges
    return _rounded(GREY + grid_sample(values, place[None], align_corners=False)[0].permute(1, 2, 0))


def _rectangles(
    corners: Float[Tensor, "*views lower further 2"],
) -> tuple[Float[Tensor, "*views rows columns 2"], Float[Tensor, "*views rows columns 2"]]:
    """The middles and the sides (across, down) of the rectangles about pixels with these corners."""
    a, b = corners[..., :-1, :-1, :], corners[..., :-1, 1:, :]
    c, d = corners[..., 1:, :-1, :], corners[..., 1:, 1:, :]
    across, down = (b + d - a - c) / 2, (c + d - a - b) / 2
    return (a + b + c + d) / 4, (across.square() + down.square()).sqrt()


def _rounded(mean: Float[Tensor, "*views rows columns bands"]) -> UInt8[Tensor, "*views rows columns bands"]:
    return ((mean * TIES).round() / TIES).round().clamp(0, 255).to(torch.uint8)


def _sampled(
    bands: Float[Tensor, "bands bottom right"], x: Float[Tensor, "rows columns"], y: Tensor
) -> Float[Tensor, "rows columns bands"]:
    """`_at` by torch's own interpolation, in half the time; graphs in float64 do not have it."""
    size = bands.new_tensor([bands.shape[2] - 1, bands.shape[1] - 1])
    place = (2 * torch.stack([x, y], dim=-1) / size - 1).nan_to_num(-1.0)
    return grid_sample(bands[None], place[None], padding_mode="border", align_corners=True)[0].permute(1, 2, 0)


def _at(
    table: Float[Tensor, "bottom right bands"], x: Float[Tensor, "*views rows columns"], y: Tensor
) -> Float[Tensor, "*views rows columns bands"]:
    """The table at corners between pixels: linear along both axes, as the sums are inside a pixel."""
    height, width, bands = table.shape
    x, y = (value.nan_to_num(-1.0).clamp(0, size - 1) for value, size in ((x, width), (y, height)))
    column, row = x.floor().long(), y.floor().long()
    next_column = (column + 1).clamp_max(width - 1)
    upper, lower = row * width, (row + 1).clamp_max(height - 1) * width
    flat = table.reshape(-1, bands)
    places = (upper + column, upper + next_column, lower + column, lower + next_column)
    a, b, c, d = (flat.index_select(0, place.flatten()).reshape(*place.shape, bands) for place in places)
    x, y = (x - column)[..., None], (y - row)[..., None]
    return (a * (1 - x) + b * x) * (1 - y) + (c * (1 - x) + d * x) * y

"""Views of an image whose pixels are means over areas: plain functions of torch, which exported graphs share."""

from collections.abc import Sequence

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
    (x, width), (y, height) = (_extents(axis) for axis in corners.unbind(-1))
    width, height = width.clamp_min(1), height.clamp_min(1)
    left, right, top, bottom = x - width / 2, x + width / 2, y - height / 2, y + height / 2
    total = _at(table, right, bottom) - _at(table, left, bottom) - _at(table, right, top) + _at(table, left, top)
    return _rounded((total / (width * height)[..., None]).nan_to_num(0.0))  # NaN where a corner is


def view(
    image: UInt8[Tensor, "height width bands"], corners: Float[Tensor, "lower further 2"]
) -> UInt8[Tensor, "rows columns bands"]:
    """The view of an image whose pixels have their corners at these places: `area_means`, in less time.

    If no pixel is larger than those of the image, the means are bilinear interpolations, which need a quarter of the
    look-ups and no sums. All are computed in float64 and differ in its rounding alone.
    """
    extents = [_extents(axis) for axis in corners.unbind(-1)]
    is_shrunk = any((side > 1).any() for _, side in extents)
    means = (_shrunk if is_shrunk else _enlarged)(image.permute(2, 0, 1), extents)
    return _rounded(means.permute(1, 2, 0))


def _extents(
    corners: Float[Tensor, "*views lower further"],
) -> tuple[Float[Tensor, "*views rows columns"], Float[Tensor, "*views rows columns"]]:
    """Along one axis: the middles of pixels with these corners, and the sides of their rectangles."""
    upper, lower = corners[..., :-1, :], corners[..., 1:, :]
    both, edge = upper + lower, lower - upper
    across, down = both[..., 1:] - both[..., :-1], edge[..., 1:] + edge[..., :-1]
    return (both[..., 1:] + both[..., :-1]) / 4, (across.square() + down.square()).sqrt() / 2


def _enlarged(
    image: UInt8[Tensor, "bands height width"], extents: Sequence[tuple[Tensor, Tensor]]
) -> Float[Tensor, "bands rows columns"]:
    """The interpolated values, less grey."""
    less_grey = torch.empty(image.shape, dtype=torch.float64).copy_(image).sub_(GREY)  # zero beyond the edges
    x, y = (
        (middle * (2 / n) - 1).nan_to_num_(BEYOND).clamp_(-BEYOND, BEYOND)
        for (middle, _), n in zip(extents, image.shape[:0:-1], strict=True)
    )
    return grid_sample(less_grey[None], torch.stack([x, y], dim=-1)[None], align_corners=False)[0]


def _shrunk(
    image: UInt8[Tensor, "bands height width"], extents: Sequence[tuple[Tensor, Tensor]]
) -> Float[Tensor, "bands rows columns"]:
    """The means, less grey, by torch's own interpolation of the `sums`, in half the time; graphs do not have it."""
    bands, height, width = image.shape
    table = torch.zeros(bands, height + 1, width + 1, dtype=torch.float64)
    table[:, 1:, 1:].copy_(image).sub_(GREY)
    table.cumsum_(1).cumsum_(2)
    area, ends = torch.ones(()), []
    for (middle, side), n in zip(extents, (width, height), strict=True):
        side = side.clamp_min(1)
        area, place, half = area * side, middle * (2 / n) - 1, side / n
        ends.append((place - half, place + half))
    (left, right), (top, bottom) = ends
    total = _summed(table, right, bottom).sub_(_summed(table, left, bottom))
    total.sub_(_summed(table, right, top)).add_(_summed(table, left, top))
    return total.div_(area).nan_to_num_(0.0)  # NaN where a corner is


def _summed(
    table: Float[Tensor, "bands bottom right"], x: Float[Tensor, "rows columns"], y: Float[Tensor, "rows columns"]
) -> Float[Tensor, "bands rows columns"]:
    """`_at`, for places from -1 to 1; NaN counts as -1."""
    place = torch.stack([x, y], dim=-1)[None]
    return grid_sample(table[None], place, padding_mode="border", align_corners=True)[0]


def _rounded(mean: Float[Tensor, "*views rows columns bands"]) -> UInt8[Tensor, "*views rows columns bands"]:
    """The values whose means, less grey, these are."""
    return ((mean * TIES).round() / TIES + GREY).round().to(torch.uint8)


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

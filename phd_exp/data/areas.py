"""Views of an image whose pixels are means over areas: plain functions of torch, which exported graphs share."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int32, UInt8
from torch import Tensor
from torch.nn.functional import grid_sample, pad

GREY = 128  # all colours of transparent pixels and of those beyond the edges of an image
TIES = {torch.float64: 1e6, torch.float32: 2.0**15}
"""Means are rounded to 1/TIES first, so that halves are exact whatever the order of the sums."""

BEYOND = 3.0  # a place outside every image, in units of half its size from the middle


def sums(image: UInt8[Tensor, "height width bands"]) -> Int32[Tensor, "height+1 width+1 bands"]:
    """Exact sums of an image minus grey over the rectangle from its top left corner to every corner of a pixel.

    The sums of large images wrap around; their differences over a rectangle remain exact.
    """
    table = pad(image, (0, 0, 1, 0, 1, 0), value=GREY).int().sub_(GREY)
    return table.cumsum_(0, dtype=torch.int32).cumsum_(1, dtype=torch.int32)


def area_means(
    table: Int32[Tensor, "bottom right bands"],
    origin: Float[Tensor, "views 2"],
    corners: Float[Tensor, "views lower further 2"],
) -> UInt8[Tensor, "views rows columns bands"]:
    """The views whose pixels have their corners at these places (column, row) of an image, given its `sums`.

    Each pixel is the mean over an upright rectangle about the middle of its corners. The rectangle has the extent of
    the pixel along both axes (the root of the sum of squares of its two edges), and at least that of a pixel of the
    image, so that views of more pixels are interpolated linearly. Beyond the image, and at NaN, all is grey.

    Places are relative to `origin`, which has whole numbers, and sums are subtracted before they are rounded, so that
    float32 suffices.
    """
    height, width, bands = table.shape
    (x, wide), (y, high) = (_extents(axis) for axis in corners.unbind(-1))
    wide, high = wide.clamp_min(1), high.clamp_min(1)
    columns, across = _ends(x, wide, origin[:, None, None, 0], width - 1)
    rows, down = _ends(y, high, origin[:, None, None, 1], height - 1)
    flat = table.reshape(-1, bands)

    def at(row: Tensor, column: Tensor) -> Tensor:
        return flat.index_select(0, (row * width + column).flatten()).reshape(*row.shape, bands)

    lines = [[at(row, column) - at(row, columns[0]) for column in columns[1:]] for row in rows]
    total = torch.zeros_like(x[..., None])
    for line, share in zip(lines[1:], down, strict=True):
        for value, first, weight in zip(line, lines[0], across, strict=True):
            total = total + (share * weight)[..., None] * (value - first).to(x.dtype)
    return _rounded((total / (wide * high)[..., None]).nan_to_num(0.0))  # NaN where a corner is


def _ends(middle: Tensor, side: Tensor, origin: Tensor, size: int) -> tuple[list[Tensor], list[Tensor]]:
    """The four corners of pixels next to both ends of intervals, which are cut to [0, `size`], and the weights of the
    last three in the integral over an interval; the weight of the first is minus their sum.
    """
    ends = torch.stack([middle - side / 2, middle + side / 2]).nan_to_num(0.0)
    ends = ends.maximum(-origin).minimum(size - origin)
    before = ends.floor()
    (lower, upper), part = (before + origin).nan_to_num(0.0).clamp(0, size).long(), ends - before
    places = [lower, (lower + 1).clamp_max(size), upper, (upper + 1).clamp_max(size)]
    return places, [-part[0], 1 - part[1], part[1]]


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
    """The interpolated values minus grey."""
    less_grey = torch.empty(image.shape, dtype=torch.float64).copy_(image).sub_(GREY)  # zero beyond the edges
    x, y = (
        (middle * (2 / n) - 1).nan_to_num_(BEYOND).clamp_(-BEYOND, BEYOND)
        for (middle, _), n in zip(extents, image.shape[:0:-1], strict=True)
    )
    return grid_sample(less_grey[None], torch.stack([x, y], dim=-1)[None], align_corners=False)[0]


def _shrunk(
    image: UInt8[Tensor, "bands height width"], extents: Sequence[tuple[Tensor, Tensor]]
) -> Float[Tensor, "bands rows columns"]:
    """The means minus grey, by torch's own interpolation of the sums, in half the time; graphs do not have it."""
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
    """The table at corners between pixels, from -1 to 1: linear along both axes; NaN counts as -1."""
    place = torch.stack([x, y], dim=-1)[None]
    return grid_sample(table[None], place, padding_mode="border", align_corners=True)[0]


def _rounded(mean: Float[Tensor, "*views rows columns bands"]) -> UInt8[Tensor, "*views rows columns bands"]:
    """The values of pixels, given their means minus grey."""
    ties = TIES[mean.dtype]
    return ((mean * ties).round() / ties + GREY).round().to(torch.uint8)

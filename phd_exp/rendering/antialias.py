"""Smooth edges: each surface's share of a pixel from geometry instead of random rays.

The path tracer computes the light at the middle of each pixel, which shows a single surface. A pixel's value is the
mean of that light over Blender's own pixel filter (Blackman-Harris, 1.5 px: three pixels from end to end). Along
edges, a tracer estimates the surfaces' shares from a few random rays per pixel, which causes three quarters of the
error left after denoising. Here the shares come from rays that carry no light and cost almost nothing.
"""

from functools import cache
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phd_exp.records.scenes import Scene
from phd_exp.rendering.pixels import Box, Light
from phd_exp.rendering.rays import Labels, Mask, silhouette, trace_points
from phd_exp.rendering.triangles import Meshes

FILTER_WIDTH = 3.0  # px
FINER = 3  # points along a side of a pixel at which the silhouettes of meshes are computed
SIDES = (-1, -1, 1, 1)  # of a box that is a pixel larger
REACH = 2  # px from a pixel to the farthest one that its filter touches
POINTS = 13  # rays a pixel; with GENERATOR a Fibonacci lattice, whose points differ in both coordinates
GENERATOR = 5


def smoothed(light: Light, surfaces: Labels, scene: Scene) -> Light:
    """Light (S, S, 3), filtered along edges, from light at the middles of pixels, which show `surfaces` (S, S)."""
    rows, columns = np.nonzero(edges(surfaces, REACH))
    right, down = filter_points()
    x, y = columns[:, None] + 0.5 + right, rows[:, None] + 0.5 + down
    seen = trace_points(scene, x, y).first
    row, column = _donors(surfaces, seen, x, y)
    result = light.copy()
    result[rows, columns] = light[row, column].mean(axis=1)
    return result


def edges(surfaces: Labels, reach: int) -> Mask:
    """Pixels (S, S) with another surface within `reach` columns and rows."""
    size = 2 * reach + 1
    return np.asarray(ndimage.minimum_filter(surfaces, size) != ndimage.maximum_filter(surfaces, size))


@cache  # the same for every picture
def filter_points() -> tuple[Light, Light]:
    """Offsets to the right and down (POINTS,), px, distributed as the filter, so that their weights are equal."""
    number = np.arange(POINTS) - POINTS // 2  # about the middle: the lattice is its own quarter turn
    places = np.linspace(0, 1, 4097)
    weights = pixel_filter(places)
    share = (np.cumsum(weights) - weights / 2) / weights.sum()
    even = (number / POINTS + 0.5, (number * GENERATOR / POINTS + 0.5) % 1)
    right, down = (FILTER_WIDTH * (np.interp(u, share, places) - 0.5) for u in even)
    return right, down


def pixel_filter(places: Light) -> Light:
    """Blender's pixel filter at places from 0, one end, to 1."""
    angle = 2 * np.pi * places
    return 0.35875 - 0.48829 * np.cos(angle) + 0.14128 * np.cos(2 * angle) - 0.01168 * np.cos(3 * angle)


def filtered(fine: NDArray[np.floating[Any]], finer: int) -> Light:
    """Values (rows, columns, channels) of pixels from those at `finer` points along each of their sides.

    The points are those of (rows + 2, columns + 2) pixels, because the filter reaches one pixel beyond each.
    """
    from phd_exp.rendering.rasterizing import filtered_rows

    weights = pixel_filter((np.arange(3 * finer) + 0.5) / (3 * finer)).astype(np.float32)
    weights /= weights.sum()
    rows = filtered_rows(np.ascontiguousarray(fine), weights, finer)
    return filtered_rows(np.ascontiguousarray(rows.swapaxes(0, 1)), weights, finer).swapaxes(0, 1)


def coverage(scene: Scene, box: Box, meshes: Meshes) -> Light:
    """The share of each pixel of a box (height, width, 1), under the filter, that opaque objects cover."""
    finer = scene.model_copy(update={"S": FINER * scene.S, "f": FINER * scene.f})
    left, top, right, bottom = around = Box(*(FINER * (edge + side) for edge, side in zip(box, SIDES, strict=True)))
    covered: Light = np.zeros((bottom - top, right - left, 1))
    for number in range(len(scene.objects)):
        shown, part = silhouette(finer, number, meshes, around)
        covered[part.top - top : part.bottom - top, part.left - left : part.right - left][shown] = 1.0
    return filtered(covered, FINER)


def _donors(surfaces: Labels, seen: Labels, x: Light, y: Light) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """For each point, the pixel that provides its light: its own, or the nearest one that shows the same surface.

    If no pixel nearby shows that surface in its middle, the point's own pixel provides the light.
    """
    last = len(surfaces) - 1
    row, column = (np.floor(place).astype(np.intp).clip(0, last) for place in (y, x))
    lost = np.nonzero(surfaces[row, column] != seen)
    for down, right in _NEIGHBOURS:
        if not len(lost[0]):
            break
        near = (row[lost] + down).clip(0, last), (column[lost] + right).clip(0, last)
        found = surfaces[near] == seen[lost]
        hit = tuple(axis[found] for axis in lost)
        row[hit], column[hit] = near[0][found], near[1][found]
        lost = tuple(axis[~found] for axis in lost)
    return row, column


_STEPS = range(-REACH, REACH + 1)
_NEIGHBOURS = sorted(product(_STEPS, _STEPS), key=lambda step: step[0] ** 2 + step[1] ** 2)[1:]  # without itself

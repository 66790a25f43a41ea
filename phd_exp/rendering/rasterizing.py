"""The depth of triangles in the middles of pixels, compiled: importing this file takes a second."""
# mypy: allow-untyped-defs

import math

from numba import njit


@njit(cache=True)
def _span(a, b, c, end):
    return range(max(0, math.ceil(min(a, b, c))), min(end, math.floor(max(a, b, c)) + 1))


@njit(cache=True)
def lower_depths(x, y, inverse, corners, depths):
    """Lower the depths (rows, columns) to those of triangles, whose 1/z is linear in the image."""
    for a, b, c in corners:
        area = (x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a])
        if area == 0:
            continue
        for row in _span(y[a], y[b], y[c], depths.shape[0]):
            for column in _span(x[a], x[b], x[c], depths.shape[1]):
                at_a = ((x[c] - x[b]) * (row - y[b]) - (y[c] - y[b]) * (column - x[b])) / area
                at_b = ((x[a] - x[c]) * (row - y[c]) - (y[a] - y[c]) * (column - x[c])) / area
                at_c = 1 - at_a - at_b
                if at_a >= 0 and at_b >= 0 and at_c >= 0:
                    depth = 1 / (at_a * inverse[a] + at_b * inverse[b] + at_c * inverse[c])
                    depths[row, column] = min(depths[row, column], depth)

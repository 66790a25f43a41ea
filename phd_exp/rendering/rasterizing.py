"""What is compiled, because it visits pixel after pixel: importing this file takes a second."""
# mypy: allow-untyped-defs

import math

import numpy as np
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


@njit(cache=True, fastmath=True)
def look_up(panorama, turn, rays):
    """Light of the directions turn (u, v, 1), u along columns and v along rows, by interpolation."""
    height, width = panorama.shape[:2]
    turns, halves = np.float32(width / (2 * math.pi)), np.float32(height / math.pi)
    light = np.empty((len(rays), len(rays), 3), np.float32)
    for row in range(len(rays)):
        for column in range(len(rays)):
            u, v = rays[column], rays[row]
            x = turn[0, 0] * u + turn[0, 1] * v + turn[0, 2]
            y = turn[1, 0] * u + turn[1, 1] * v + turn[1, 2]
            z = turn[2, 0] * u + turn[2, 1] * v + turn[2, 2]
            across = np.float32(0.5 * width - 0.5) - math.atan2(y, x) * turns
            up = np.float32(0.5 * height - 0.5) + math.atan2(z, math.sqrt(x * x + y * y)) * halves
            left, below = math.floor(across), math.floor(up)
            to_right, to_above = across - left, up - below
            first, last = int(left) % width, (int(left) + 1) % width
            low, high = min(max(int(below), 0), height - 1), min(int(below) + 1, height - 1)
            for c in range(3):
                lower = panorama[low, first, c] * (1 - to_right) + panorama[low, last, c] * to_right
                upper = panorama[high, first, c] * (1 - to_right) + panorama[high, last, c] * to_right
                light[row, column, c] = lower * (1 - to_above) + upper * to_above
    return light


@njit(cache=True, fastmath=True)
def filtered_rows(fine, weights, finer):
    """Weighted means along the first axis (finer (n + 2), ...), of rows from the first of each pixel: (n, ...)."""
    n = fine.shape[0] // finer - 2
    result = np.zeros((n, fine.shape[1], fine.shape[2]), np.float32)
    for row in range(n):
        for step in range(len(weights)):
            for column in range(fine.shape[1]):
                for c in range(fine.shape[2]):
                    result[row, column, c] += weights[step] * fine[finer * row + step, column, c]
    return result

"""Meshes as triangles: their size, and the depth of their surface in each pixel."""
# mypy: allow-untyped-defs

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

Depths = NDArray[np.float64]


@dataclass(frozen=True)
class Triangles:
    """A mesh in its local frame: vertices (n, 3), m, and the three vertices of each triangle (m, 3)."""

    vertices: NDArray[np.float64]
    corners: NDArray[np.int32]

    @property
    def dimensions(self) -> tuple[float, float, float]:
        """Extent along the local axes, m; a flat mesh is a micrometre thick."""
        x, y, z = np.maximum(np.ptp(self.vertices, axis=0), 1e-6).tolist()
        return x, y, z

    @property
    def radius(self) -> float:
        """Distance of the farthest vertex from the reference point, m."""
        return float(np.linalg.norm(self.vertices, axis=1).max())

    @property
    def centroid(self) -> NDArray[np.float64]:
        """Centroid (3,) of the surface, m."""
        a, b, c = np.moveaxis(self.vertices[self.corners], 1, 0)
        areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        return np.average((a + b + c) / 3, axis=0, weights=areas + 1e-300)

    def silhouette(self, rotation: Depths, translation: Depths, f: float, S: int) -> tuple[range, range]:
        """Rows and columns, possibly outside the image, that contain the silhouette."""
        x, y, _ = self._projected(rotation, translation, f, S)
        rows, columns = (range(math.floor(along.min()), math.ceil(along.max())) for along in (y, x))
        return rows, columns

    def depths(self, rotation: Depths, translation: Depths, f: float, S: int, rows: range, columns: range) -> Depths:
        """Depth z (rows, columns) of the surface in the middles of pixels, m; infinity where a ray misses it.

        `rotation` (3, 3) and `translation` (3,) map the local frame, at the object's scale, to the camera's. The mesh
        lies in front of the camera.
        """
        x, y, z = self._projected(rotation, translation, f, S)
        result = np.full((len(rows), len(columns)), np.inf)
        _draw(x - columns.start - 0.5, y - rows.start - 0.5, 1 / z, self.corners, result)
        return result

    def _projected(self, rotation: Depths, translation: Depths, f: float, S: int) -> Depths:
        x, y, z = (self.vertices @ rotation.T + translation).T
        return np.stack([f * x / z + S / 2, f * y / z + S / 2, z])


Meshes = Mapping[str, Triangles]


@njit(cache=True)
def _span(a, b, c, end):
    return range(max(0, math.ceil(min(a, b, c))), min(end, math.floor(max(a, b, c)) + 1))


@njit(cache=True)
def _draw(x, y, inverse, corners, depths):
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

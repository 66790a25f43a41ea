"""Meshes as triangles: their size, and the depth of their surface in each pixel."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from phd_exp.optics.virtual import product
from phd_exp.rendering.pixels import Box

Depths = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Triangles:
    """A mesh in its local frame: vertices (n, 3), m, and the three vertices of each triangle (m, 3).

    `is_opaque`: whether light passes through none of its triangles.
    """

    vertices: NDArray[np.float64]
    corners: NDArray[np.int32]
    is_opaque: bool = True

    @property
    def dimensions(self) -> tuple[float, float, float]:
        """Extent along the local axes, m; a flat mesh is a micrometre thick."""
        x, y, z = np.maximum(np.ptp(self.vertices, axis=0), 1e-6).tolist()
        return x, y, z

    @cached_property
    def radius(self) -> float:
        """Distance of the farthest vertex from the reference point, m."""
        return float(np.linalg.norm(self.vertices, axis=1).max())

    @property
    def areas(self) -> NDArray[np.float64]:
        """Area (m,) of each triangle, m^2."""
        a, b, c = np.moveaxis(self.vertices[self.corners], 1, 0)
        return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2

    @property
    def centroid(self) -> NDArray[np.float64]:
        """Centroid (3,) of the surface, m."""
        middles = np.add.reduce(np.moveaxis(self.vertices[self.corners], 1, 0)) / 3
        return np.average(middles, axis=0, weights=self.areas + 1e-300)

    def window(self, turn: Depths, shift: Depths, f: float, S: int) -> Box:
        """The bounding box of its silhouette, possibly outside the image (S, S)."""
        x, y, _ = self._seen(turn, shift, f, S)
        (left, right), (top, bottom) = ((math.floor(v.min()), math.ceil(v.max()) + 1) for v in (x, y))
        return Box(left, top, right, bottom)

    def depths(self, turn: Depths, shift: Depths, f: float, S: int, box: Box | None = None) -> Depths:
        """Depth z of the surface in the middles of pixels, m; infinity where a ray misses it.

        The pixels are those of the image (S, S), or of a box. The mesh lies in front of
        the camera, to whose frame `turn` (3, 3) and `shift` (3,) map the local one.
        """
        from phd_exp.rendering.rasterizing import lower_depths

        left, top, right, bottom = box or Box(0, 0, S, S)
        x, y, z = self._seen(turn, shift, f, S)
        result = np.full((bottom - top, right - left), np.inf)
        lower_depths(x - left, y - top, 1 / z, self.corners, result)
        return result

    def _seen(self, turn: Depths, shift: Depths, f: float, S: int) -> tuple[Depths, Depths, Depths]:
        """Columns and rows of the vertices, counted from the middle of the first pixel, and their depths z, m."""
        x, y, z = (product(self.vertices, turn.T) + shift).T
        return f * x / z + S / 2 - 0.5, f * y / z + S / 2 - 0.5, z


Meshes = Mapping[str, Triangles]
"""The imported objects by their names in a scene: `mesh`, `mesh1`, ..."""
NO_MESHES: Meshes = {}

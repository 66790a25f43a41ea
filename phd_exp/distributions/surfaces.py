"""Closed surfaces of triangles: around the region of a credible level, and ellipsoids; their outlines on images."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import stats
from scipy.spatial import ConvexHull

from phd_exp.distributions.projected_huber import ProjectedHuber
from phd_exp.distributions.regions import Region
from phd_exp.optics.virtual import VirtualCamera


@dataclass(frozen=True, eq=False)
class Surface:
    """A closed surface; the three vertices of each triangle run anticlockwise if looked at from outside."""

    vertices: Float[np.ndarray, "vertices 3"]
    triangles: Int[np.ndarray, "triangles 3"]

    @property
    def normals(self) -> Float[np.ndarray, "vertices 3"]:
        """Unit vectors that point outwards: the mean over the triangles at each vertex, weighted by their areas."""
        a, b, c = self.vertices[self.triangles.T]
        sums = np.zeros_like(self.vertices)
        for corner in self.triangles.T:
            np.add.at(sums, corner, np.cross(b - a, c - a))
        return np.asarray(sums / np.linalg.norm(sums, axis=-1, keepdims=True))


def level_surface(distribution: ProjectedHuber, level: float, depths: int = 21, angles: int = 48) -> Surface:
    """The surface of the smallest region with the probability `level`, which is convex, in metres.

    Its vertices are exact, on rings of `angles` positions each at `depths` depths; see `Region.rings`.

    Examples:
        >>> import torch
        >>> p = ProjectedHuber(torch.zeros(2), torch.tensor(4.0), 100 * torch.eye(2), torch.tensor(20.0))
        >>> surface = level_surface(p, 0.9)
        >>> surface.vertices.shape, surface.triangles.shape
        ((914, 3), (1824, 3))
    """
    return _closed(Region(distribution, level).rings(depths, angles))


def ellipsoid(mean: Float[np.ndarray, "3"], covariance: Float[np.ndarray, "3 3"], level: float) -> Surface:
    """The ellipsoid that has the probability `level` under a Gaussian."""
    across, around = np.linspace(0, np.pi, 21)[:, None], 2 * np.pi / 48 * np.arange(48)
    sphere = np.stack(
        np.broadcast_arrays(np.sin(across) * np.cos(around), np.sin(across) * np.sin(around), -np.cos(across)), -1
    )
    return _closed(mean + gaussian_radius(level) * sphere @ np.linalg.cholesky(covariance).T)


def gaussian_radius(level: float) -> float:
    """The Mahalanobis distance in three dimensions within which a Gaussian has the probability `level`."""
    return float(np.sqrt(stats.chi2.ppf(level, 3)))


def outline(points: Float[np.ndarray, "n 3"], camera: VirtualCamera) -> Float[np.ndarray, "m 2"]:
    """The closed outline of the convex hull of points (metres, frame of `camera`), pixels of the real image.

    Empty if not all points are before the virtual camera; without the parts that the lens of the real one hides.
    """
    if not (points[:, 2] > 0).all():
        return np.zeros((0, 2))
    flat = points[:, :2] / points[:, 2:]
    hull = ConvexHull(flat, qhull_options="QbB").vertices
    pixels = camera.real_pixels(flat[[*hull, hull[0]]])
    return np.asarray(pixels[np.isfinite(pixels).all(-1)])


def _closed(rings: Float[np.ndarray, "depths angles 3"]) -> Surface:
    """The surface through rings, of which the first and the last are a point."""
    depths, angles = rings.shape[:2]
    vertices = np.concatenate([rings[:1, 0], rings[1:-1].reshape(-1, 3), rings[-1:, 0]])
    last, here = len(vertices) - 1, np.arange(angles)
    beyond = (here + 1) % angles
    bands = 1 + angles * np.arange(depths - 3)[:, None]
    a, b, c, d = bands + here, bands + beyond, bands + angles + here, bands + angles + beyond
    triangles = [
        np.stack([0 * here, 1 + beyond, 1 + here], -1),
        np.stack([a, b, d], -1).reshape(-1, 3),
        np.stack([a, d, c], -1).reshape(-1, 3),
        np.stack([last + 0 * here, last - angles + here, last - angles + beyond], -1),
    ]
    return Surface(vertices, np.concatenate(triangles))

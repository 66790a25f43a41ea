"""How an object can lie on a table: on which of its sides it comes to rest, and how often."""

from functools import cache

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from phd_exp.rendering.triangles import Triangles

UP = (0.0, 0.0, 1.0)
THIN = 1e-12  # share of the thickness of a flat mesh, whose centre of mass is between two triangles
FEWEST = 4  # vertices of a hull
JOGGLED = "QJ"  # Qhull moves vertices by rounding errors, so that flat meshes have a hull too


Rests = tuple[Float[np.ndarray, "sides 3"], Float[np.ndarray, " sides"]]
"""Outward unit normals of the stable sides of an object, in its local frame, and the share of each; the sum is 1."""


def resting_turn(mesh: Triangles, rng: np.random.Generator) -> Rotation:
    """The rotation that turns a random stable side of an object down, to -z of a frame whose z axis points up."""
    down, share = rests_of(mesh)
    return Rotation.align_vectors([UP], [-down[rng.choice(len(share), p=share)]])[0]


@cache  # of each mesh, which is the same for every picture
def rests_of(mesh: Triangles) -> Rests:
    """The sides of the convex hull of an object on which it lies stably.

    An object that is dropped in a random orientation, without momentum, first touches a triangle of the hull with a
    probability proportional to the solid angle that it has from the centre of mass. It then rolls over edges until
    the centre of mass is above the triangle below. The centre of mass is taken to be the centroid of the hull's
    surface.

    Source: quasi-static poses of K. Goldberg et al., "Part pose statistics" (1999).
    """
    vertices = mesh.vertices
    if len(vertices) < FEWEST:  # a single triangle
        vertices = np.vstack([vertices, vertices])
    hull = ConvexHull(vertices, qhull_options=JOGGLED)
    corners = vertices[hull.simplices] - Triangles(vertices, hull.simplices).centroid
    down = hull.equations[:, :3]
    share = np.bincount(_rolled(corners, down, hull.neighbors), _solid_angles(corners), len(down))
    sides = np.flatnonzero(share)
    return down[sides], share[sides] / share.sum()


def _rolled(
    corners: Float[np.ndarray, "triangles 3 3"],
    down: Float[np.ndarray, "triangles 3"],
    neighbours: Int[np.ndarray, "triangles 3"],
) -> Int[np.ndarray, " triangles"]:
    """The triangle on which the object comes to rest after touching each, relative to the centre of mass.

    Neighbour k lies beyond the edge opposite to corner k; there, the foot of the centre of mass has a negative
    barycentric coordinate k.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    foot = (a * down).sum(1, keepdims=True) * down
    areas = [(np.cross(q - foot, r - foot) * down).sum(1) for q, r in ((b, c), (c, a), (a, b))]
    share = np.stack(areas, axis=1) * np.sign(sum(areas))[:, None]
    own = np.arange(len(down))
    following = np.where(share.min(1) < 0, neighbours[own, share.argmin(1)], own)
    for _ in range(len(down).bit_length()):  # after k rounds, 2^k steps
        following = following[following]
    return following


def _solid_angles(corners: Float[np.ndarray, "triangles 3 3"]) -> Float[np.ndarray, " triangles"]:
    """The solid angle of each triangle, seen from the origin.

    Source: A. van Oosterom and J. Strackee, "The solid angle of a plane triangle" (1983).
    """
    a, b, c = np.moveaxis(corners, 1, 0)
    p, q, r = (np.linalg.norm(corner, axis=1) for corner in (a, b, c))
    volume = np.abs((a * np.cross(b, c)).sum(1)) + THIN * p * q * r
    rest = p * q * r + (a * b).sum(1) * r + (b * c).sum(1) * p + (c * a).sum(1) * q
    angles: Float[np.ndarray, " triangles"] = 2 * np.arctan2(volume, rest)
    return angles

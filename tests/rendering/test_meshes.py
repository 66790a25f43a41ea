"""The meshes are closed, face outward, and are the solids that rays are cast at."""

import math
from collections import Counter
from typing import get_args

import numpy as np
import pytest

from phd_exp.records.scenes import Shape
from phd_exp.rendering.meshes import Mesh, build_mesh

VOLUME = {"cylinder": 2 * math.pi, "cube": 8.0, "sphere": 4 / 3 * math.pi}
SHAPES = get_args(Shape)


def directed_edges(mesh: Mesh) -> Counter[tuple[tuple[float, ...], tuple[float, ...]]]:
    """Edges by the places of their ends: vertices that share a place are one."""
    places = [tuple(np.round(point, 9).tolist()) for point in mesh.vertices]
    return Counter(
        (places[a], places[b]) for face in mesh.faces for a, b in zip(face, (*face[1:], face[0]), strict=True)
    )


@pytest.mark.parametrize("shape", SHAPES)
def test_a_mesh_is_closed_faces_outward_and_is_its_solid(shape: Shape) -> None:
    mesh = build_mesh(shape)
    edges = directed_edges(mesh)
    assert set(edges.values()) == {1}, "every edge is walked once in each direction"
    assert all((b, a) in edges for a, b in edges)

    points = np.array(mesh.vertices)
    triangles = [(face[0], face[k], face[k + 1]) for face in mesh.faces for k in range(1, len(face) - 1)]
    volume = np.linalg.det(points[np.array(triangles)]).sum() / 6
    assert volume == pytest.approx(VOLUME[shape], rel=1e-3), "positive, since faces look outward"

    x, y, z = points.T
    distance = {
        "cylinder": np.maximum(np.hypot(x, y), np.abs(z)),
        "cube": np.abs(points).max(axis=1),
        "sphere": np.linalg.norm(points, axis=1),
    }[shape]
    assert distance == pytest.approx(1.0), "every vertex lies on the surface"

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
def test_a_mesh_is_closed(shape: Shape) -> None:
    """Every edge is walked once in each direction."""
    edges = directed_edges(build_mesh(shape))
    assert set(edges.values()) == {1}
    assert all((b, a) in edges for a, b in edges)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_mesh_has_the_volume_of_its_solid(shape: Shape) -> None:
    """The signed volume is positive: faces look outward."""
    mesh = build_mesh(shape)
    points = np.array(mesh.vertices)
    volume = sum(
        np.linalg.det(points[[face[0], face[k], face[k + 1]]]) / 6
        for face in mesh.faces
        for k in range(1, len(face) - 1)
    )
    assert volume == pytest.approx(VOLUME[shape], rel=1e-3)


@pytest.mark.parametrize("shape", SHAPES)
def test_every_vertex_lies_on_the_surface(shape: Shape) -> None:
    x, y, z = np.array(build_mesh(shape).vertices).T
    distance = {
        "cylinder": np.maximum(np.hypot(x, y), np.abs(z)),
        "cube": np.maximum(np.maximum(np.abs(x), np.abs(y)), np.abs(z)),
        "sphere": np.sqrt(x * x + y * y + z * z),
    }[shape]
    assert distance == pytest.approx(1.0)

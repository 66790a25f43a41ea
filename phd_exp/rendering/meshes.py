"""The three shapes as meshes that fill the cube [-1, 1]^3: plain lists, which tests check without Blender."""

import math
from dataclasses import dataclass

Point = tuple[float, float, float]
Face = tuple[int, ...]

# A polygon of n sides deviates from its circle by at most r (1 - cos(pi / n)): 0.01 px at the worst.
SIDES = 192
RINGS = 96


@dataclass(frozen=True)
class Mesh:
    """Vertices, faces (counter-clockwise from outside), and whether each face is shaded as a curved surface."""

    vertices: list[Point]
    faces: list[Face]
    smooth: list[bool]


def build_mesh(shape: str) -> Mesh:
    """The mesh of a shape without bevels, the same solid as in `rays`."""
    return {"cylinder": _cylinder, "cube": _cube, "sphere": _sphere}[shape]()


def _cylinder() -> Mesh:
    """Axis z; the caps have separate vertices, so that shading stops at the sharp rim."""
    rings = [_circle(z=-1.0), _circle(z=1.0)]
    vertices = [point for _ in range(2) for ring in rings for point in ring]
    sides = [(i, (i + 1) % SIDES, SIDES + (i + 1) % SIDES, SIDES + i) for i in range(SIDES)]
    bottom = tuple(range(3 * SIDES - 1, 2 * SIDES - 1, -1))
    top = tuple(range(3 * SIDES, 4 * SIDES))
    return Mesh(vertices, [*sides, bottom, top], [True] * SIDES + [False, False])


def _cube() -> Mesh:
    vertices = [(x, y, z) for z in (-1.0, 1.0) for y in (-1.0, 1.0) for x in (-1.0, 1.0)]
    faces: list[Face] = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    return Mesh(vertices, faces, [False] * 6)


def _sphere() -> Mesh:
    """Rings of constant latitude between two poles."""
    latitudes = [math.pi * ring / RINGS - math.pi / 2 for ring in range(1, RINGS)]
    rings = [_circle(z=math.sin(latitude), radius=math.cos(latitude)) for latitude in latitudes]
    vertices = [(0.0, 0.0, -1.0), *(point for ring in rings for point in ring), (0.0, 0.0, 1.0)]
    last = len(vertices) - 1
    faces: list[Face] = []
    for i in range(SIDES):
        j = (i + 1) % SIDES
        faces.append((0, 1 + j, 1 + i))
        for start in range(1, last - SIDES, SIDES):
            faces.append((start + i, start + j, start + SIDES + j, start + SIDES + i))
        faces.append((last, last - SIDES + i, last - SIDES + j))
    return Mesh(vertices, faces, [True] * len(faces))


def _circle(z: float, radius: float = 1.0) -> list[Point]:
    angles = [math.tau * side / SIDES for side in range(SIDES)]
    return [(radius * math.cos(angle), radius * math.sin(angle), z) for angle in angles]

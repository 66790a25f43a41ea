"""The sides on which objects lie: against symmetry, geometry and rolling step by step."""

from itertools import product

import numpy as np
import pytest
from scipy import stats
from scipy.spatial import ConvexHull

from phd_exp.rendering.rays import rotation_matrix
from phd_exp.rendering.resting import Rests, rests_of
from phd_exp.rendering.triangles import Triangles
from tests.support.meshes import placed, solid
from tests.support.renders import UNLIKELY, MakeSpec, drawn

CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))


def rests_on(points: np.ndarray) -> Rests:
    """Those of a mesh with these vertices; its triangles do not matter."""
    return rests_of(Triangles(points, np.empty((0, 3), np.int32)))


def share_of(rests: Rests, direction: list[float]) -> float:
    """The share of the sides with this normal; a flat side is several triangles."""
    down, share = rests
    return float(share[down @ np.array(direction) > 1 - 1e-9].sum())


def test_a_cube_lies_on_each_side_equally_often() -> None:
    rests = rests_on(CORNERS)
    for direction in (*np.eye(3), *-np.eye(3)):
        assert share_of(rests, direction) == pytest.approx(1 / 6)


def test_a_box_lies_on_its_largest_sides_most_often() -> None:
    """By the solid angle of a rectangle (2a, 2b) at the distance d: 4 arcsin(ab / sqrt((a^2 + d^2)(b^2 + d^2)))."""
    rests = rests_on(CORNERS * [1, 2, 3])
    for axis, (d, a, b) in enumerate(((1, 2, 3), (2, 1, 3), (3, 1, 2))):
        angle = 4 * np.arcsin(a * b / np.sqrt((a**2 + d**2) * (b**2 + d**2)))
        assert share_of(rests, np.eye(3)[axis]) == pytest.approx(angle / (4 * np.pi))


def test_an_object_rolls_off_sides_on_which_it_would_tip() -> None:
    """A leaning tower, whose centre of mass is not above its ends: it lies on one of its four long sides."""
    tower = CORNERS * [1, 1, 4] + CORNERS[:, 2:] * [2.0, 0, 0]
    rests = rests_on(tower)
    assert share_of(rests, [0, 0, 1]) == share_of(rests, [0, 0, -1]) == 0
    assert rests[1].sum() == pytest.approx(1)


@pytest.mark.parametrize("n", [3, 4], ids=["triangle", "rectangle"])
def test_a_flat_object_lies_on_either_side(n: int) -> None:
    rests = rests_on(CORNERS[::2][:n] * [1, 2, 0])
    assert share_of(rests, [0, 0, 1]) == pytest.approx(0.5, abs=1e-3)
    assert share_of(rests, [0, 0, -1]) == pytest.approx(0.5, abs=1e-3)


def test_every_side_is_stable() -> None:
    """The centre of mass is above the part of the object that touches the table, of 20 random objects."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        points = rng.normal(size=(30, 3)) * [1, 2, 0.5]
        hull, rests = ConvexHull(points), rests_on(points)
        centre = Triangles(points, hull.simplices).centroid
        assert rests[1].sum() == pytest.approx(1)
        for down in rests[0]:
            height = points @ -down
            touching = points[height < height.min() + 1e-9]
            assert len(touching) == 3, "a triangle"
            corners = touching - centre
            weights = np.linalg.solve(corners.T, corners[0] @ down * down)
            assert weights.sum() == pytest.approx(1)
            assert weights.min() > 0


@pytest.mark.parametrize("ground", [False, True])
def test_resting_objects_touch_the_table_with_a_side(of_mesh: MakeSpec, ground: bool) -> None:
    """The lowest corners of a cube are four at one height, where the ground is; each side is down equally often."""
    meshes = {"mesh": solid("cube")}
    spec = of_mesh(resting=True, ground=ground, pitch_range=(20.0, 40.0), scale_range=(0.5, 1.0))
    sides = []
    for scene in drawn(spec, 300, meshes):
        assert scene.surroundings is not None
        item, pitch = scene.objects[0], scene.surroundings.pitch
        up = np.array([0.0, -np.cos(pitch), -np.sin(pitch)])
        R = rotation_matrix(item.rotation)
        height = np.sort(placed(meshes["mesh"], item) @ up)
        assert height[3] == pytest.approx(height[0])
        assert height[4] == pytest.approx(height[0] + 0.2 * item.scale)
        if ground:
            assert np.array(scene.surroundings.ground) @ up == pytest.approx(height[0])
        sides.append(int(np.argmax(np.abs(R.T @ up))) * 2 + int((R.T @ up).sum() > 0))
    assert stats.chisquare(np.bincount(sides, minlength=6)).pvalue > UNLIKELY

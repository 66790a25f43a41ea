"""Rotations as quaternions are those of scipy, which turns the same way by other formulas."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from phd_exp.rendering.rotations import about_axis, rotation_matrix, uniform_rotation


def reference(quaternion: tuple[float, float, float, float]) -> np.ndarray:
    w, x, y, z = quaternion
    return Rotation.from_quat([x, y, z, w]).as_matrix()


def test_a_matrix_is_that_of_its_quaternion() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        quaternion = uniform_rotation(rng)
        assert math.hypot(*quaternion) == pytest.approx(1, abs=1e-12)
        matrix = rotation_matrix(quaternion)
        assert matrix == pytest.approx(reference(quaternion), abs=1e-12)
        opposite = rotation_matrix(tuple(-part for part in quaternion))  # type: ignore[arg-type]
        assert opposite == pytest.approx(matrix, abs=1e-12)


@pytest.mark.parametrize("angle", [-3.0, 0.0, 0.3, math.pi / 2])
def test_a_turn_about_an_axis_is_right_handed(angle: float) -> None:
    for axis in ((1.0, 0.0, 0.0), (0.0, 0.6, -0.8)):
        expected = Rotation.from_rotvec(angle * np.array(axis)).as_matrix()
        assert rotation_matrix(about_axis(axis, angle)) == pytest.approx(expected, abs=1e-12)
    x_becomes_y = rotation_matrix(about_axis((0.0, 0.0, 1.0), math.pi / 2)) @ [1.0, 0.0, 0.0]
    assert x_becomes_y == pytest.approx([0.0, 1.0, 0.0], abs=1e-12)

"""Rotations as unit quaternions (w, x, y, z), and as matrices: numpy alone."""

import math

import numpy as np
from numpy.typing import NDArray

Quaternion = tuple[float, float, float, float]
Matrix = NDArray[np.float64]


def rotation_matrix(quaternion: Quaternion) -> Matrix:
    """Matrix (3, 3) of a unit quaternion."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def about_axis(axis: tuple[float, float, float], angle: float) -> Quaternion:
    """Unit quaternion of a right-handed turn by `angle` (radians) about a unit vector."""
    x, y, z = (math.sin(angle / 2) * component for component in axis)
    return math.cos(angle / 2), x, y, z


def uniform_rotation(rng: np.random.Generator) -> Quaternion:
    """A rotation uniform over all of them (the Haar measure of SO(3)).

    Source: K. Shoemake, "Uniform random rotations", Graphics Gems III (1992).
    """
    u, first, second = rng.random(3).tolist()
    a, b = math.sqrt(1 - u), math.sqrt(u)
    return (
        b * math.cos(math.tau * second),
        a * math.sin(math.tau * first),
        a * math.cos(math.tau * first),
        b * math.sin(math.tau * second),
    )

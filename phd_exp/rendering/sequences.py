"""Sequences: the objects of a scene move, and so may the camera.

Each coordinate of an object is a function of a smooth stationary Gaussian process, such that in every frame it has
the distribution of single images: depth is uniform in `z_range`, x and y are uniform over the field of view at that
depth. Objects therefore never leave the field. The first frame is a single image. A further camera of a sequence
keeps its direction and moves so that the same holds for the cylinder in its frame.
"""

import math

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from scipy.special import ndtr, ndtri

from phd_exp.optics.virtual import product, unit
from phd_exp.records.scenes import Pose, Quaternion, SceneObject, Vector
from phd_exp.records.spec import DatasetSpec

Stream = np.random.Generator

WAVES = 3  # sinusoids of a Gaussian process
FREQUENCIES = (0.5, 1.5)  # bounds of their frequencies, before these are scaled
EDGE = 1e-9  # least distance of a coordinate from the ends of its range, as a share; there the process is infinite
RMS_SLOPE = math.sqrt(2 / (math.pi * math.sqrt(3)))
"""Root mean square of ds/dy = 2 phi(y) for s = 2 Phi(y) - 1 with y ~ N(0, 1); E[phi(y)^2] = 1/(2 pi sqrt 3)."""


def moved(item: SceneObject, spec: DatasetSpec, f: float, time: float, rng: Stream) -> SceneObject:
    """An object in the camera's frame at a time (seconds), given that at time 0.

    The object turns about a random axis at a constant rate, uniform in `spec.spin_range` (degrees per second).
    """
    position = slid(item.position, spec, f, time, rng)
    axis = rng.standard_normal(3)
    turn = time * math.radians(rng.uniform(*spec.spin_range)) * unit(axis)
    rotation = quaternion_of(Rotation.from_rotvec(turn) * rotation_of(item.rotation))
    return item.model_copy(update={"position": position, "rotation": rotation})


def slid(position: Vector, spec: DatasetSpec, f: float, time: float, rng: Stream) -> Vector:
    """A position in the camera's frame at a time (seconds), given that at time 0.

    Each coordinate has the root mean square speed `spec.speed` (m/s; x and y at the middle depth).
    """
    near, far = spec.z_range
    half_width = 0.5 * spec.xy_range * spec.sensor_size / f
    x, y, z = position
    depth = _slid(z, (near, far), spec.speed, time, rng)
    at_middle = spec.speed / ((near + far) / 2)
    x, y = (depth * _slid(value / z, (-half_width, half_width), at_middle, time, rng) for value in (x, y))
    return x, y, depth


def camera_pose(spec: DatasetSpec, time: float, rng: Stream) -> Pose:
    """The pose of the camera at a time (seconds), the scene's frame at time 0.

    Its centre moves along each axis, and it turns about each axis, as Gaussian processes with the root mean square
    rates `spec.camera_speed` (m/s) and `spec.camera_turn` (degrees per second).
    """
    turn, centre = ([_wandered(time, rng) for _ in range(3)] for _ in range(2))
    R = Rotation.from_rotvec(math.radians(spec.camera_turn) * np.array(turn))
    x, y, z = product(-R.as_matrix(), spec.camera_speed * np.array(centre)).tolist()
    return Pose(rotation=quaternion_of(R), translation=(x, y, z))


def in_scene(item: SceneObject, pose: Pose, *, turned: bool) -> SceneObject:
    """An object given in the camera's frame, in the scene's; its rotation too if it is to be `turned`."""
    back = rotation_of(pose.rotation).inv()
    x, y, z = product(back.as_matrix(), np.array(item.position) - pose.translation).tolist()
    rotation = quaternion_of(back * rotation_of(item.rotation)) if turned else item.rotation
    return item.model_copy(update={"position": (x, y, z), "rotation": rotation})


def _slid(value: float, bounds: tuple[float, float], speed: float, time: float, rng: Stream) -> float:
    """A coordinate with this value at time 0, uniform between the bounds at any time."""
    low, high = bounds
    half, middle = (high - low) / 2, (low + high) / 2
    omega, cosines, sines = _waves(rng)
    if half == 0:
        return value
    start = ndtri(np.clip((value - low) / (high - low), EDGE, 1 - EDGE))
    cosines += (start - cosines.sum() / math.sqrt(WAVES)) / math.sqrt(WAVES)  # given its value at time 0
    phase = speed / (half * RMS_SLOPE) * time * omega
    y = (cosines * np.cos(phase) + sines * np.sin(phase)).sum() / math.sqrt(WAVES)
    return float(middle + half * (2 * ndtr(y) - 1))


def _wandered(time: float, rng: Stream) -> float:
    """The way since time 0 of a stationary Gaussian process whose rate has the variance 1."""
    omega, cosines, sines = _waves(rng)
    return float((cosines * (np.cos(time * omega) - 1) + sines * np.sin(time * omega)).sum() / math.sqrt(WAVES))


def _waves(rng: Stream) -> tuple[Float[np.ndarray, " waves"], ...]:
    """Frequencies of mean square 1 (radians per unit of time), and the normal coefficients of cosines and sines."""
    omega = rng.uniform(*FREQUENCIES, WAVES)
    omega /= np.sqrt((omega**2).mean())
    return omega, rng.standard_normal(WAVES), rng.standard_normal(WAVES)


def rotation_of(quaternion: Quaternion) -> Rotation:
    """The rotation of a unit quaternion (w, x, y, z)."""
    return Rotation.from_quat(quaternion, scalar_first=True)


def quaternion_of(rotation: Rotation) -> Quaternion:
    """Unit quaternion (w, x, y, z)."""
    w, x, y, z = rotation.as_quat(scalar_first=True).tolist()
    return w, x, y, z

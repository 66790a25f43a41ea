"""The same problem for a generic conic solver (Clarabel), written down from the paper's formulas."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import clarabel
import numpy as np
import torch
from scipy import sparse

from phd_exp.distributions import ProjectedHuber
from phd_exp.fusion import Pose


@dataclass(frozen=True)
class Camera:
    """One prediction and its pose, as arrays."""

    mu_xy: np.ndarray
    mu_z: float
    A: np.ndarray
    a: float
    k: np.ndarray
    rounding: float
    R: np.ndarray
    t: np.ndarray


def cameras_of(predictions: ProjectedHuber, pose: Pose) -> list[list[Camera]]:
    k = torch.zeros_like(predictions.mu_xy) if predictions.k is None else predictions.k
    rounding = torch.full_like(predictions.a, predictions.rounding)
    columns = (predictions.mu_xy, predictions.mu_z, predictions.A, predictions.a, k, rounding, pose.R, pose.t)
    arrays = [column.numpy() for column in columns]
    problems, cameras = predictions.batch_shape
    return [[Camera(*(array[i, j] for array in arrays)) for j in range(cameras)] for i in range(problems)]


def unknowns_of(camera: Camera) -> int:
    """The number of unknowns m, n, w, ... of `cones_of`."""
    return 4 if camera.rounding else 3


def cones_of(
    camera: Camera, xyz: np.ndarray, at: np.ndarray, m: np.ndarray, n: np.ndarray, w: np.ndarray, *v: np.ndarray
) -> Iterator[tuple[object, np.ndarray, np.ndarray]]:
    """Cones that contain slope x + constant, of a camera whose position of the object is xyz x + at.

    h(|q|) = min m^2/2 + n over |q| <= m + n, n >= 0; max(t, 1/t) = min w over w >= t, w t >= 1. With a rounded mode
    w is restricted by (w - t)(w - v) >= (rounding/a)^2 and v t >= 1.
    """
    q = camera.A @ (xyz[:2] - np.outer(camera.mu_xy, xyz[2])) / camera.mu_z
    q_0 = camera.A @ (at[:2] - camera.mu_xy * at[2]) / camera.mu_z
    t, t_0 = xyz[2] / camera.mu_z, at[2] / camera.mu_z
    q, q_0 = q + camera.a * np.outer(camera.k, t), q_0 + camera.a * camera.k * (t_0 - 1)
    inverse = v[0] if v else w
    yield clarabel.NonnegativeConeT(2), np.stack([n, w - t]), np.array([0, -t_0])
    yield clarabel.SecondOrderConeT(3), np.vstack([m + n, q]), np.array([0, *q_0])
    above = np.stack([inverse + t, inverse - t, np.zeros_like(t)])
    yield clarabel.SecondOrderConeT(3), above, np.array([t_0, -t_0, 2])
    for one in v:
        barrier = np.stack([2 * w - t - one, one - t, np.zeros_like(t)])
        yield clarabel.SecondOrderConeT(3), barrier, np.array([-t_0, -t_0, 2 * camera.rounding / camera.a])


class Conic:
    """minimise diagonal.x^2/2 + c.x over n unknowns x, with affine expressions of x in cones; sparse if large."""

    def __init__(self, n: int, is_large: bool) -> None:
        self.n, self.is_large = n, is_large
        self.diagonal, self.c = np.zeros(n), np.zeros(n)
        self.rows: list[Any] = []
        self.constants: list[np.ndarray] = []
        self.cones: list[object] = []

    def require(self, cone: object, slope: np.ndarray, constant: np.ndarray) -> None:
        """slope x + constant lies in the cone."""
        self.rows.append(sparse.csc_matrix(-slope) if self.is_large else -slope)
        self.constants.append(constant)
        self.cones.append(cone)

    def add_camera(self, camera: Camera, place: int, origin: np.ndarray, unit: float, first: int) -> int:
        """The energy of a camera for v = origin + unit x[place:], with its own unknowns from `first` on.

        Returns the first unknown after them.
        """
        own = [np.eye(1, self.n, first + i)[0] for i in range(unknowns_of(camera))]
        self.diagonal[first] = 1
        self.c[first + 1], self.c[first + 2] = 1, camera.a
        xyz = np.zeros((3, self.n))
        xyz[:, place : place + 3] = camera.R * unit
        for cone, slope, constant in cones_of(camera, xyz, camera.R @ origin + camera.t, *own):
            self.require(cone, slope, constant)
        return first + len(own)

    def solved(self, tolerance: float) -> np.ndarray:
        """The unknowns."""
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
        P, constants = sparse.diags(self.diagonal).tocsc(), np.concatenate(self.constants)
        rows = sparse.vstack(self.rows).tocsc() if self.is_large else sparse.csc_matrix(np.vstack(self.rows))
        return np.array(clarabel.DefaultSolver(P, self.c, rows, constants, self.cones, settings).solve().x)


class Program(Conic):
    """The problem of one position: x = (v - origin)/unit, then the unknowns of each camera."""

    def __init__(self, cameras: list[Camera], origin: np.ndarray, unit: float) -> None:
        super().__init__(3 + sum(map(unknowns_of, cameras)), is_large=False)
        self.origin, self.unit, first = origin, unit, 3
        for camera in cameras:
            first = self.add_camera(camera, 0, origin, unit, first)

    def on_plane(self, normal: np.ndarray, offset: float) -> "Program":
        """With the constraint normal . v = offset."""
        row = np.zeros((1, self.n))
        row[0, :3] = normal * self.unit
        self.require(clarabel.ZeroConeT(1), row, np.array([normal @ self.origin - offset]))
        return self

    def solve(self, tolerance: float) -> np.ndarray:
        """The position v."""
        return self.origin + self.unit * self.solved(tolerance)[:3]

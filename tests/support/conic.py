"""The same problem for a generic conic solver (Clarabel), written down from the paper's formulas."""

from collections.abc import Iterator
from dataclasses import dataclass

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
    R: np.ndarray
    t: np.ndarray


def cameras_of(predictions: ProjectedHuber, pose: Pose) -> list[list[Camera]]:
    k = torch.zeros_like(predictions.mu_xy) if predictions.k is None else predictions.k
    columns = (predictions.mu_xy, predictions.mu_z, predictions.A, predictions.a, k, pose.R, pose.t)
    arrays = [column.numpy() for column in columns]
    problems, cameras = predictions.batch_shape
    return [[Camera(*(array[i, j] for array in arrays)) for j in range(cameras)] for i in range(problems)]


def cones_of(
    camera: Camera, xyz: np.ndarray, at: np.ndarray, m: np.ndarray, n: np.ndarray, w: np.ndarray
) -> Iterator[tuple[object, np.ndarray, np.ndarray]]:
    """Cones that contain slope x + constant, of a camera whose position of the object is xyz x + at.

    h(|q|) = min m^2/2 + n over |q| <= m + n, n >= 0; max(t, 1/t) = min w over w >= t, w t >= 1.
    """
    q = camera.A @ (xyz[:2] - np.outer(camera.mu_xy, xyz[2])) / camera.mu_z
    q_0 = camera.A @ (at[:2] - camera.mu_xy * at[2]) / camera.mu_z
    t, t_0 = xyz[2] / camera.mu_z, at[2] / camera.mu_z
    q, q_0 = q + camera.a * np.outer(camera.k, t), q_0 + camera.a * camera.k * (t_0 - 1)
    yield clarabel.NonnegativeConeT(2), np.stack([n, w - t]), np.array([0, -t_0])
    yield clarabel.SecondOrderConeT(3), np.vstack([m + n, q]), np.array([0, *q_0])
    yield clarabel.SecondOrderConeT(3), np.stack([w + t, w - t, np.zeros_like(t)]), np.array([t_0, -t_0, 2])


class Program:
    """minimise x.P x/2 + c.x with affine expressions of x in cones; x = (v - origin)/unit, then the rest."""

    def __init__(self, cameras: list[Camera], origin: np.ndarray, unit: float) -> None:
        self.n = 3 + 3 * len(cameras)
        self.P, self.c = np.zeros((self.n, self.n)), np.zeros(self.n)
        self.rows: list[np.ndarray] = []
        self.constants: list[np.ndarray] = []
        self.cones: list[object] = []
        self.origin, self.unit = origin, unit
        for i, camera in enumerate(cameras):
            self.add_camera(camera, 3 + 3 * i)

    def require(self, cone: object, slope: np.ndarray, constant: np.ndarray) -> None:
        """slope x + constant lies in the cone."""
        self.rows.append(-slope)
        self.constants.append(constant)
        self.cones.append(cone)

    def add_camera(self, camera: Camera, first: int) -> None:
        """The energy of a camera, with m, n and w from the unknown `first` on."""
        m, n, w = np.eye(self.n)[first : first + 3]
        self.P[first, first] = 1
        self.c[first + 1], self.c[first + 2] = 1, camera.a
        xyz = np.zeros((3, self.n))
        xyz[:, :3] = camera.R * self.unit
        for cone, slope, constant in cones_of(camera, xyz, camera.R @ self.origin + camera.t, m, n, w):
            self.require(cone, slope, constant)

    def on_plane(self, normal: np.ndarray, offset: float) -> "Program":
        """With the constraint normal . v = offset."""
        row = np.zeros((1, self.n))
        row[0, :3] = normal * self.unit
        self.require(clarabel.ZeroConeT(1), row, np.array([normal @ self.origin - offset]))
        return self

    def solve(self, tolerance: float = 1e-14) -> tuple[np.ndarray, str]:
        """The position v, and the status of the solver."""
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
        P, rows = sparse.csc_matrix(self.P), sparse.csc_matrix(np.vstack(self.rows))
        constants = np.concatenate(self.constants)
        solution = clarabel.DefaultSolver(P, self.c, rows, constants, self.cones, settings).solve()
        return self.origin + self.unit * np.array(solution.x[:3]), str(solution.status)

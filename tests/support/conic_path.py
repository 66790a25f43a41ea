"""Paths for a generic conic solver (Clarabel), written down from the formulas, with their energy."""

import clarabel
import numpy as np
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.fusion import Pose
from tests.support.conic import Conic, cameras_of, unknowns_of


def noise(step: float, density: float) -> np.ndarray:
    """Covariance of (position, velocity) after this time of white acceleration noise."""
    one_axis = density**2 * np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
    return np.kron(one_axis, np.eye(3))


def motion(step: float) -> np.ndarray:
    """(position, velocity) after this time at constant velocity."""
    return np.kron(np.array([[1, step], [0, 1]]), np.eye(3))


class PathProgram(Conic):
    """The problem of a path: unknowns (v_k - origin, velocity_k), noise e, and m, n, w of each view."""

    def __init__(
        self, times: np.ndarray, predictions: ProjectedHuber, pose: Pose, mask: Tensor, density: float, speed: float
    ) -> None:
        frames = cameras_of(predictions, Pose(pose.R.expand(*mask.shape, 3, 3), pose.t.expand(*mask.shape, 3)))
        self.views = [(k, camera) for k, row in enumerate(frames) for c, camera in enumerate(row) if mask[k, c]]
        self.times, self.density, self.speed = times, density, speed
        self.origin = np.array([0.0, 0.0, 4.0])
        N = len(times)
        first = 12 * N - 6
        super().__init__(first + sum(unknowns_of(camera) for _, camera in self.views), is_large=True)
        self.diagonal[3:6] = 1 / speed**2
        for k, step in enumerate(np.diff(times)):
            self.add_motion(k, step)
        for k, camera in self.views:
            first = self.add_camera(camera, 6 * k, self.origin, 1.0, first)

    def add_motion(self, k: int, step: float) -> None:
        """x_(k+1) = F x_k + root e_k, with |e_k|^2/2 in the energy."""
        first = 6 * len(self.times) + 6 * k
        self.diagonal[first : first + 6] = 1
        slope = np.zeros((6, self.n))
        whiten = np.linalg.inv(np.linalg.cholesky(noise(step, self.density)))
        slope[:, 6 * k : 6 * k + 6], slope[:, 6 * k + 6 : 6 * k + 12] = whiten @ motion(step), -whiten
        slope[:, first : first + 6] = np.eye(6)
        self.require(clarabel.ZeroConeT(6), slope, np.zeros(6))

    def solve(self, tolerance: float) -> np.ndarray:
        """The unknowns (frames, 6)."""
        x = self.solved(tolerance)[: 6 * len(self.times)]
        return x.reshape(-1, 6) + np.append(self.origin, np.zeros(3))

    def energy(self, x: np.ndarray) -> np.longdouble:
        """-log density of position and velocity (frames, 6) up to constants."""
        x = x.astype(np.longdouble)
        value = (x[0, 3:] ** 2).sum() / self.speed**2 / 2
        for k, step in enumerate(np.diff(self.times)):
            residual = x[k + 1] - motion(step) @ x[k]
            value += residual @ np.linalg.inv(noise(step, self.density)) @ residual / 2
        for k, camera in self.views:
            v = camera.R @ x[k, :3] + camera.t
            q = camera.A @ (v[:2] - camera.mu_xy * v[2]) / camera.mu_z
            t = v[2] / camera.mu_z
            q = q + camera.a * camera.k * (t - 1)
            r = np.sqrt((q**2).sum())
            width, g = camera.rounding / camera.a, (t - 1 / t) / 2
            value += (r**2 / 2 if r <= 1 else r - np.longdouble(0.5)) + camera.a * (t - g + np.sqrt(g**2 + width**2))
        return value

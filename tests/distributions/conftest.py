"""The distributions over which every law is tested, all in float64."""

import math

import pytest
import torch

from phd_exp.distributions import ProjectedHuber

F, S, MU_Z0 = 1500.0, 224.0, 2.5e-3  # so z_p = 1 at 3.75 m


def from_camera_frame(
    mu_xy: tuple[float, float],
    mu_z: float,
    eigenvalues: tuple[float, float],
    angle: float,
    a: float,
    k: tuple[float, float] | None = None,
    rounding: float = 0.0,
) -> ProjectedHuber:
    """A distribution whose A has the given eigenvalues and direction of the first of them."""
    c, s = math.cos(angle), math.sin(angle)
    U = torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
    A = U @ torch.diag(torch.tensor(eigenvalues, dtype=torch.float64)) @ U.T
    centre, mu_z_, a_ = (torch.tensor(x, dtype=torch.float64) for x in (mu_xy, mu_z, a))
    k_ = k and torch.tensor(k, dtype=torch.float64)
    return ProjectedHuber(centre, mu_z_, (A + A.T) / 2, a_, k_, rounding=rounding)


def from_raw(*raw: float) -> ProjectedHuber:
    return ProjectedHuber.from_raw(torch.tensor(raw, dtype=torch.float64), f=F, S=S, mu_z0=MU_Z0)


FREE = {
    "free axis": from_camera_frame((0.05, -0.03), 4.2, (120.0, 250.0), 0.6, 25.0, (1.4, -0.6)),
    "free axis, wide in depth": from_camera_frame((0.02, 0.03), 3.2, (30.0, 50.0), 0.6, 1.0, (-0.5, 2.0)),
    "free axis, sharp": from_camera_frame((0.03, 0.07), 4.9, (2000.0, 700.0), 2.0, 1e4, (0.5, 3.0)),
}
ROUNDED = {
    "rounded": from_camera_frame((0.05, -0.03), 4.2, (120.0, 250.0), 0.6, 25.0, (1.4, -0.6), 2.0),
    "rounded, wide in depth": from_camera_frame((0.02, 0.03), 3.2, (300.0, 150.0), 0.6, 0.7, rounding=2.0),
    "rounded, sharp": from_camera_frame((0.03, 0.07), 4.9, (2000.0, 700.0), 2.0, 1e4, (0.5, 3.0), 0.5),
}
INSTANCES = {
    "untrained network": from_raw(0, 0, 0, 0, 0, 0, 0),
    "generic raw": from_raw(0.4, -0.8, 1.3, 0.7, 2.1, 3.0, -0.9),
    "vague raw": from_raw(-0.3, 0.2, -1.5, 0.4, -0.7, -1.2, 0.6),
    "trained network": from_raw(20.0, -45.0, 90.0, 15.0, 120.0, 60.0, 4.0),
    "wide in depth": from_camera_frame((0.05, -0.03), 4.2, (400.0, 250.0), 0.6, 0.4),
    "wide in projection": from_camera_frame((-0.06, 0.01), 3.1, (3.0, 40.0), -1.1, 80.0),
    "sharp": from_camera_frame((0.03, 0.07), 4.9, (2000.0, 700.0), 2.0, 1e4),
    **FREE,
    **ROUNDED,
}


@pytest.fixture(scope="session", params=INSTANCES.values(), ids=INSTANCES.keys())
def distribution(request: pytest.FixtureRequest) -> ProjectedHuber:
    return request.param

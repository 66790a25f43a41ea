"""The densities over which every law is tested (float64), and raw numbers for the head of every model."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.distributions import Density, Mixture, PointEstimate, ProjectedHuber
from phd_exp.geometry import Camera
from tests.support.heads import head

F, S, MU_Z0 = 1500.0, 224.0, 2.5e-3  # so z_p = 1 at 3.75 m
F_RANGE, Z_RANGE = (1200.0, 2000.0), (3.0, 5.0)
MIDDLE_F = (F_RANGE[0] * F_RANGE[1]) ** 0.5
BASELINES = ("mae_vz", "mae_logz", "mae_xyz", "mae_constf")
HUBERS = ("probabilistic", "free_axis", "rounded_t")
SHAPED = ("gaussian", "gaussian_mixture", "student_t", "decomposed")
HEADS = {name: head(name) for name in (*HUBERS, *SHAPED, *BASELINES)}
SCALE = 0.1  # of the baselines' residuals, in units of their charts


def from_camera_frame(
    mu_xy: Sequence[float],
    mu_z: float,
    eigenvalues: Sequence[float],
    angle: float,
    a: float,
    k: Sequence[float] | None = None,
    rounding: float = 0.0,
) -> ProjectedHuber:
    """A distribution whose A has the given eigenvalues and direction of the first of them."""
    c, s = math.cos(angle), math.sin(angle)
    U = torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
    A = U @ torch.diag(torch.tensor(eigenvalues, dtype=torch.float64)) @ U.T
    centre, mu_z_, a_ = (torch.tensor(x, dtype=torch.float64) for x in (mu_xy, mu_z, a))
    k_ = None if k is None else torch.tensor(k, dtype=torch.float64)
    return ProjectedHuber(centre, mu_z_, (A + A.T) / 2, a_, k_, rounding=rounding)


def from_raw(raw: Sequence[float] | Tensor, f: float = F) -> ProjectedHuber:
    return ProjectedHuber.from_raw(torch.as_tensor(raw, dtype=torch.float64), f=f, S=S, mu_z0=MU_Z0)


def parameters(p: ProjectedHuber) -> dict[str, Tensor]:
    """The tensors that the constructor takes; with a free axis also k."""
    found = {"mu_xy": p.mu_xy, "mu_z": p.mu_z, "A": p.A, "a": p.a}
    return found if p.k is None else found | {"k": p.k}


TRAINED = (20.0, -45.0, 90.0, 15.0, 120.0, 60.0, 4.0)
FREE = {
    "free axis": from_camera_frame((0.05, -0.03), 4.2, (120.0, 250.0), 0.6, 25.0, (1.4, -0.6)),
    "free axis, wide in depth": from_camera_frame((0.02, 0.03), 3.2, (30.0, 50.0), 0.6, 1.0, (-0.5, 2.0)),
    "free axis, sharp": from_camera_frame((0.03, 0.07), 4.9, (2000.0, 700.0), 2.0, 1e4, (0.5, 3.0)),
}
INSTANCES = {
    "untrained network": from_raw([0.0] * 7),
    "generic raw": from_raw((0.4, -0.8, 1.3, 0.7, 2.1, 3.0, -0.9)),
    "vague raw": from_raw((-0.3, 0.2, -1.5, 0.4, -0.7, -1.2, 0.6)),
    "trained network": from_raw(TRAINED),
    "wide in depth": from_camera_frame((0.05, -0.03), 4.2, (400.0, 250.0), 0.6, 0.4),
    "wide in projection": from_camera_frame((-0.06, 0.01), 3.1, (3.0, 40.0), -1.1, 80.0),
    "sharp": from_camera_frame((0.03, 0.07), 4.9, (2000.0, 700.0), 2.0, 1e4),
    **FREE,
    "rounded": FREE["free axis"].with_rounding(2.0),
    "rounded, wide in depth": from_camera_frame((0.02, 0.03), 3.2, (300.0, 150.0), 0.6, 0.7, rounding=2.0),
    "rounded, sharp": FREE["free axis, sharp"].with_rounding(0.5),
}
"""Projected Huber densities."""


def shaped_raw(model: str, place: str) -> Tensor:
    """Raw numbers of an untrained, a generic or a trained network."""
    seven, further = {
        "untrained": ([0.0] * 7, [0.0] * 3),
        "generic": ([0.4, -0.8, 1.3, 0.7, 2.1, 7.0, -0.9], [0.4, -0.7, 2.0]),
        "trained": ([20.0, -45.0, 90.0, 15.0, 120.0, 200.0, 4.0], [0.4, -0.7, 2.0]),
    }[place]
    raw = torch.tensor(seven + further, dtype=torch.float64)
    if model != "gaussian_mixture":
        return raw[: HEADS[model].n_outputs]
    apart = torch.tensor(
        [[0.0] * 9, [0.3, 0.2, -0.2, 0.1, 0.3, -0.4, 0.2, 0.1, 0.0], [-0.5, 0.3, 0.4, 0.0, 0.2, 0.6, -0.3, 0.0, 0.3]]
    )
    return torch.cat([(raw[:9] + apart).flatten(), torch.tensor([0.2, -0.3, 0.0])])


def shaped(model: str, place: str, dtype: torch.dtype = torch.float64) -> Density:
    camera = Camera(torch.tensor(1550.0, dtype=dtype), S)
    return HEADS[model](shaped_raw(model, place).to(dtype), camera)  # type: ignore[return-value]


OTHERS = {
    f"{model}, {place}": shaped(model, place) for model in SHAPED for place in ("untrained", "generic", "trained")
}
"""Densities of other shapes."""


def ensemble(spread: float, members: int, batch: tuple[int, ...] = (), numbers: int = 7) -> Mixture:
    """Trained networks that disagree by about `spread` standard deviations."""
    noise = torch.randn(*batch, members, numbers, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    scale = torch.tensor([1.0, 1, 10, 10, 10, 6, 1, 0.3, 0.3], dtype=torch.float64)
    raw = torch.tensor((*TRAINED, 1.2, -0.5), dtype=torch.float64) + spread * scale * _padded(noise)
    return Mixture(from_raw(raw[..., :numbers]))


def _padded(noise: Tensor) -> Tensor:
    return torch.nn.functional.pad(noise, (0, 9 - noise.shape[-1]))


_APART = [TRAINED, (25.0, -45.0, 90.0, 0.0, 100.0, 80.0, -15.0)]
_WIDE = [
    (-16.0, -45, 70, 20, 90, 2.0, -4, 2, -1),
    (50, -20, 120, 0, 150, 5, 6, -2, 1),
    (20, -90, 60, 15, 120, 1, 0, 0, 2),
]
MIXTURES = {
    "agreeing": ensemble(0.3, 5),
    "disagreeing": ensemble(2.0, 8),
    "with free axes": ensemble(1.0, 5, numbers=9),
    "apart": Mixture(from_raw(_APART)),
    "unsure of depth": Mixture(from_raw([raw[:7] for raw in _WIDE])),
    "unsure of depth, with free axes": Mixture(from_raw(_WIDE)),
}
MIXTURES |= {
    f"{name}, rounded": Mixture(MIXTURES[name].members.with_rounding(2.0)) for name in ("with free axes", "apart")
}
"""Of ensembles."""


def raw_numbers(model: str, n: int, generator: torch.Generator) -> Float[Tensor, "n numbers"]:
    """Raw numbers of all sizes: the eigenvalues of B and a over four decades, nu_p inside the image, nu_z about the
    range of depths; of baselines, positions throughout the field of view.
    """
    if model in BASELINES:
        camera = Camera(torch.full((n,), MIDDLE_F, dtype=torch.float64), S)
        return HEADS[model].chart.coordinates(in_view(n, generator), camera)  # type: ignore[attr-defined]
    uniform = torch.rand(n, 6, generator=generator, dtype=torch.float64)
    b, a = 10 ** (4 * uniform[:, 2:4] - 1), 10 ** (4 * uniform[:, 4] - 1)
    nu_p = b * (2 * uniform[:, :2] - 1)
    b_raw, w_1 = (torch.where(value < 1, value.log(), value - 1) for value in (b, a))
    w_2 = a * (uniform[:, 5] - 0.5)
    seven = torch.stack([*nu_p.T, b_raw[:, 0], torch.zeros_like(a), b_raw[:, 1], w_1, w_2], dim=-1)
    ten = torch.cat([seven, torch.randn(n, 3, generator=generator, dtype=torch.float64)], dim=-1)
    if model != "gaussian_mixture":
        return ten[:, : HEADS[model].n_outputs]
    apart = torch.randn(3, n, 10, generator=generator, dtype=torch.float64) / 2
    return torch.cat([*(ten[:, :9] + apart[..., :9]), *apart[..., 9:]], dim=-1)


def in_view(n: int, generator: torch.Generator) -> Float[Tensor, "n 3"]:
    """Positions throughout the field of view of a camera with the middle f, at depths of the data set."""
    u, v, z = torch.rand(3, n, generator=generator, dtype=torch.float64)
    depth = Z_RANGE[0] + (Z_RANGE[1] - Z_RANGE[0]) * z
    return Camera(torch.full((n,), MIDDLE_F, dtype=torch.float64), S).unproject(S * torch.stack([u, v], -1), depth)


def predicted(model: str, raw: Tensor, camera: Camera) -> "Density | PointDensity":
    """The density of a head; of a baseline, the one that its loss implies."""
    made = HEADS[model](raw, camera.with_constant_f(MIDDLE_F if model == "mae_constf" else None))
    return PointDensity(made, SCALE) if isinstance(made, PointEstimate) else made


@dataclass(frozen=True)
class PointDensity:
    """The density whose -log is the residual's norm over a constant scale, in the coordinates of the chart.

    p(v) = exp(-|c(v) - c_0|/s) |det dc/dv| / (8 pi s^3): minimising the mean norm of residuals is maximum likelihood
    under it. Coordinates that belong to z < 0 have their share of it.

    Source: own derivation (int exp(-|r|/s) d^3 r = 8 pi s^3).
    """

    estimate: PointEstimate
    scale: float

    def log_prob(self, xyz: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch"]:
        chart, camera = self.estimate.chart, self.estimate.camera
        distance = self.estimate.residual(xyz).norm(dim=-1)
        # v -> -v keeps v_p and turns z_p round, so that the determinant is that of the position in front
        in_front = torch.cat([xyz[..., :2], xyz[..., 2:].abs()], dim=-1)
        volume = chart.log_abs_det_jacobian(in_front, camera)
        value = volume - distance / self.scale - math.log(8 * math.pi * self.scale**3)
        return value.masked_fill(~distance.isfinite(), -torch.inf)

    def rsample(self, shape: Sequence[int], generator: torch.Generator) -> Float[Tensor, "*shape 3"]:
        """A random direction, and a distance of density r^2 exp(-r/s): a sum of three exponentials."""
        c_0 = self.estimate.coordinates
        uniform = torch.rand((*shape, *c_0.shape), generator=generator, dtype=c_0.dtype)
        distance = -self.scale * torch.log1p(-uniform).sum(-1, keepdim=True)
        normal = torch.randn((*shape, *c_0.shape), generator=generator, dtype=c_0.dtype)
        residual = distance * normal / normal.norm(dim=-1, keepdim=True)
        return self.estimate.chart.position(c_0 + residual, self.estimate.camera)


def point_density(model: str) -> PointDensity:
    """A baseline's density around the middle of the field of view."""
    camera = Camera(torch.tensor(1500.0, dtype=torch.float64), S)
    chart = HEADS[model].chart  # type: ignore[attr-defined]
    centre = torch.tensor([0.05, -0.03, 4.0], dtype=torch.float64)
    return PointDensity(PointEstimate(chart.coordinates(centre, camera), chart, camera), SCALE)

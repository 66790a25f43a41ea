"""Paths that follow a motion model, with predictions that follow their densities, and references for them."""

import math

import numpy as np
import torch
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.huber import sample_whitened
from phd_exp.fusion import Pose
from phd_exp.fusion.tracks.chain import Model
from phd_exp.fusion.tracks.motion import Motion
from phd_exp.fusion.tracks.slow import Slow
from tests.support.shared import with_shared_part

HERTZ = 30.0


def around(cameras: int, angle: float = 0.5) -> Pose:
    """Cameras on a circle about (0, 0, 4), `angle` (radians) apart."""
    turn = angle * torch.arange(cameras).double()
    zero, one = torch.zeros(cameras).double(), torch.ones(cameras).double()
    rows = [[turn.cos(), zero, turn.sin()], [zero, one, zero], [-turn.sin(), zero, turn.cos()]]
    R = torch.stack([torch.stack(row, -1) for row in rows], -2)
    middle = torch.tensor([0.0, 0.0, 4.0]).double()
    return Pose(R, middle - R @ middle)


def moved(
    motion: Motion, slow: Slow, cameras: int, steps: np.ndarray, random: np.random.Generator, n: int
) -> np.ndarray:
    """Unknowns of n paths by their law: (paths, frames, d);."""
    F, W = Model(motion, slow, cameras).moving(steps)
    roots = np.linalg.cholesky(np.linalg.inv(W))
    d = F.shape[-1]
    slow_unknowns = d - 3 * motion.order
    scale = np.concatenate([np.zeros(3), np.ones(slow_unknowns), np.repeat(motion.deviations, 3)])
    x = [scale * random.standard_normal((n, d))]
    for k in range(len(steps)):
        x.append(x[-1] @ F[k].T + random.standard_normal((n, d)) @ roots[k].T)
    return np.stack(x, 1)


def drawn_paths(
    n: int,
    times: np.ndarray,
    motion: Motion,
    pose: Pose,
    *,
    a: float = 20.0,
    A: float = 300.0,
    deviation: float = 0.0,
    slow: Slow | None = None,
    seed: int = 0,
) -> tuple[ProjectedHuber, Tensor]:
    """Predictions (paths, frames, cameras) and true positions about (0, 0, 4).

    `a` and `A` are the precisions apart from slow errors, `deviation` is that of the slow log depth. The law of a
    prediction given the truth is proportional to its density at the truth: in t = z/mu_z that is t^(-3) e^(-a max(t,
    1/t)).
    """
    slow, cameras = slow or Slow(), len(pose.t)
    random, generator = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    x = torch.from_numpy(moved(motion, slow, cameras, np.diff(times), random, n))
    truth = x[..., :3] + torch.tensor([0.0, 0.0, 4.0]).double()
    v = pose.into_camera(truth[:, :, None])
    assert bool((v[..., 2] > 0.3).all())
    grid = torch.linspace(-1.5, 1.5, 200001).double() * min(1.0, 20 / a)
    density = (-a * torch.maximum(grid.exp(), (-grid).exp()) - 2 * grid).softmax(0).cumsum(0)
    uniform = torch.rand(v.shape[:-1], generator=generator, dtype=torch.float64)
    t = grid[torch.searchsorted(density, uniform).clamp_max(len(grid) - 1)].exp()
    factor = torch.exp(deviation * x[..., 3, None]) if slow.depth_share else torch.ones_like(t)
    q = sample_whitened(t.shape, dtype=torch.float64, device=t.device, generator=generator)
    if slow.projection_share:
        offsets = x[..., 3 + bool(slow.depth_share) : 3 + len(slow.times(cameras))]
        q = q + slow.offset * offsets.unflatten(-1, (cameras, 2))
    mu_xy = v[..., :2] / v[..., 2:] - q / A / t[..., None]
    eye = torch.eye(2).double().expand(*t.shape, 2, 2)
    own = ProjectedHuber(mu_xy, v[..., 2] / factor / t, A * eye, torch.full_like(t, a))
    predicted = with_shared_part(own, deviation) if slow.depth_share else own
    A_all = predicted.A * math.sqrt(1 - slow.projection_share)
    return ProjectedHuber(predicted.mu_xy, predicted.mu_z, A_all, predicted.a), truth


def share_of(deviation: float, a: float) -> float:
    """The share of the variance of log depth that a slow factor of this deviation has beside the precision a."""
    one = torch.ones(1).double()
    own = ProjectedHuber(torch.zeros(1, 2).double(), one, torch.eye(2).double()[None], a * one)
    both = with_shared_part(own, deviation)
    own_ratio, ratio = (p.depth_variance / p.depth_mean.square() for p in (own, both))
    return float(1 - own_ratio / ratio)


def chosen(predictions: ProjectedHuber, index: object) -> ProjectedHuber:
    """Some of the predictions of a batch."""
    columns = predictions.mu_xy, predictions.mu_z, predictions.A, predictions.a
    return ProjectedHuber(*(column[index] for column in columns))

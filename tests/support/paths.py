"""Paths that follow a motion model, with predictions that follow their densities, and references for them."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.huber import HUBER_COVARIANCE, sample_whitened
from phd_exp.fusion import Pose
from phd_exp.fusion.tracks.chain import moving
from phd_exp.fusion.tracks.motion import Motion
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


@dataclass(frozen=True)
class Errors:
    """Slow errors, each an Ornstein-Uhlenbeck process: a factor of depth of all cameras, an offset in each.

    `deviation` is that of log depth, `share` the part of the offset in the variance of the projection; the times are
    their time constants, seconds.
    """

    deviation: float = 0.0
    depth_time: float = 1.0
    share: float = 0.0
    projection_time: float = 1.0


NO_ERRORS = Errors()


def moved(motion: Motion, steps: np.ndarray, random: np.random.Generator, n: int) -> np.ndarray:
    """Unknowns of n paths by their law: (paths, frames, d)."""
    F, W = moving(motion, steps)
    roots = np.linalg.cholesky(np.linalg.inv(W))
    d = F.shape[-1]
    scale = np.concatenate([np.zeros(3), np.repeat(motion.deviations, 3)])
    x = [scale * random.standard_normal((n, d))]
    for k in range(len(steps)):
        x.append(x[-1] @ F[k].T + random.standard_normal((n, d)) @ roots[k].T)
    return np.stack(x, 1)


def wandering(time: float, steps: np.ndarray, random: np.random.Generator, shape: tuple[int, ...]) -> Tensor:
    """Ornstein-Uhlenbeck processes of variance 1, (frames, *shape)."""
    x = [random.standard_normal(shape)]
    for decay in np.exp(-steps / time):
        x.append(decay * x[-1] + np.sqrt(1 - decay**2) * random.standard_normal(shape))
    return torch.from_numpy(np.stack(x))


def drawn_paths(
    n: int,
    times: np.ndarray,
    motion: Motion,
    pose: Pose,
    *,
    a: float = 20.0,
    A: float = 300.0,
    errors: Errors = NO_ERRORS,
    seed: int = 0,
) -> tuple[ProjectedHuber, Tensor]:
    """Predictions (paths, frames, cameras) and true positions about (0, 0, 4).

    `a` and `A` are the precisions apart from slow errors. The law of a
    prediction given the truth is proportional to its density at the truth: in t = z/mu_z that is t^(-3) e^(-a max(t,
    1/t)).
    """
    random, generator = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    x = torch.from_numpy(moved(motion, steps := np.diff(times), random, n))
    truth = x[..., :3] + torch.tensor([0.0, 0.0, 4.0]).double()
    v = pose.into_camera(truth[:, :, None])
    assert bool((v[..., 2] > 0.3).all())
    grid = torch.linspace(-1.5, 1.5, 200001).double() * min(1.0, 20 / a)
    density = (-a * torch.maximum(grid.exp(), (-grid).exp()) - 2 * grid).softmax(0).cumsum(0)
    uniform = torch.rand(v.shape[:-1], generator=generator, dtype=torch.float64)
    t = grid[torch.searchsorted(density, uniform).clamp_max(len(grid) - 1)].exp()
    factor = torch.exp(errors.deviation * wandering(errors.depth_time, steps, random, (n,))).mT[..., None]
    q = sample_whitened(t.shape, dtype=torch.float64, device=t.device, generator=generator)
    offsets = wandering(errors.projection_time, steps, random, (n, len(pose.t), 2)).movedim(0, 1)
    q = q + math.sqrt(HUBER_COVARIANCE * errors.share / (1 - errors.share)) * offsets
    mu_xy = v[..., :2] / v[..., 2:] - q / A / t[..., None]
    eye = torch.eye(2).double().expand(*t.shape, 2, 2)
    own = ProjectedHuber(mu_xy, v[..., 2] / factor / t, A * eye, torch.full_like(t, a))
    predicted = with_shared_part(own, errors.deviation) if errors.deviation else own
    A_all = predicted.A * math.sqrt(1 - errors.share)
    return ProjectedHuber(predicted.mu_xy, predicted.mu_z, A_all, predicted.a), truth

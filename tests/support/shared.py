"""Scenes whose views share an unknown factor of depth; each view alone and all together are calibrated."""

import math

import numpy as np
import torch
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.kinked import Kinked
from phd_exp.fusion import Pose

CANDIDATES = 400


def sharing_scenes(
    n: int, cameras: int, *, deviation: float, a: float, A: float, angle: float, seed: int = 0
) -> tuple[ProjectedHuber, Pose, Tensor]:
    """Predictions, poses and true positions; the cameras stand on a circle about (0, 0, 4), `angle` (radians) apart.

    `a` is the precision of a view's depth apart from the factor e^s. The first prediction is fixed; s and the truth
    are drawn from it, the others from their law given both, which for a uniform prior of positions has the density
    t^(-3) e^(-energy) in (q, t).
    """
    random = torch.Generator().manual_seed(seed)
    turn = angle * torch.arange(cameras).double()
    zero, one = torch.zeros(cameras).double(), torch.ones(cameras).double()
    rows = [[turn.cos(), zero, turn.sin()], [zero, one, zero], [-turn.sin(), zero, turn.cos()]]
    R = torch.stack([torch.stack(row, -1) for row in rows], -2).expand(n, cameras, 3, 3)
    middle = torch.tensor([0.0, 0.0, 4.0]).double()
    pose = Pose(R, middle - R @ middle)
    own = torch.full((n, cameras), a).double()
    matrix = A * torch.eye(2).double().expand(n, cameras, 2, 2)
    unit = ProjectedHuber(torch.zeros(n, cameras, 2).double(), torch.ones(n, cameras).double(), matrix, own)
    drawn = unit.rsample((CANDIDATES,), random)  # (A^(-1) q, t)
    chosen = torch.multinomial(drawn[..., 2].flatten(1).mT ** -3, 1, generator=random).reshape(1, n, cameras, 1)
    error = drawn.gather(0, chosen.expand(1, n, cameras, 3))[0]
    error[:, 0] = drawn[0, :, 0]
    factor = torch.exp(deviation * torch.randn(n, 1, generator=random).double())
    truth = 4 * factor * error[:, 0]
    v = pose.into_camera(truth[:, None])
    mu_z = v[..., 2] / (error[..., 2] * factor)
    mu_xy = v[..., :2] / v[..., 2:] - error[..., :2] / error[..., 2:]
    return with_shared_part(ProjectedHuber(mu_xy, mu_z, matrix, own), deviation), pose, truth


def with_shared_part(own: ProjectedHuber, deviation: float) -> ProjectedHuber:
    """The predictions with the mean and covariance of e^s v, for v of these densities."""
    growth = math.exp(deviation**2)
    known = torch.linspace(-8, 14, 20001).double()  # log a

    def mean_and_ratio(log_a: Tensor) -> tuple[Tensor, Tensor]:
        mean, variance = Kinked(log_a).moments
        return mean, variance / mean**2

    mean, ratio = mean_and_ratio(own.a.log())
    wanted = (1 + ratio) * growth - 1
    log_a = torch.from_numpy(np.interp(-wanted.numpy(), -mean_and_ratio(known)[1].numpy(), known.numpy()))
    change = mean / mean_and_ratio(log_a)[0] * math.sqrt(growth)
    return ProjectedHuber(own.mu_xy, own.mu_z * change, own.A * (change / growth)[..., None, None], log_a.exp())

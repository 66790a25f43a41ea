"""Scenes whose views share an unknown factor of depth; each view alone and all together are calibrated."""

import torch
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.fusion import Pose
from phd_exp.fusion.shared import own_part

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
    own = a * torch.exp(0.2 * torch.randn(n, cameras, generator=random).double())
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
    """The predictions whose `own_part` this is, by bisection of a; mu_z and A follow from the ratios."""
    low, high = own.a / 1000, own.a * 1.0

    def at(a: Tensor) -> tuple[ProjectedHuber, ProjectedHuber]:
        views = ProjectedHuber(own.mu_xy, own.mu_z, own.A, a)
        return views, own_part(views, torch.tensor(deviation, dtype=torch.float64))[0]

    for _ in range(50):
        middle = (low * high).sqrt()
        below = at(middle)[1].a < own.a
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    views, part = at(low)
    change = own.mu_z / part.mu_z
    return ProjectedHuber(
        own.mu_xy, own.mu_z * change, own.A * (own.A[..., 0, 0] / part.A[..., 0, 0])[..., None, None], views.a
    )

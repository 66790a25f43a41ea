"""Random problems: cameras all around an object, predictions with errors of their own law, and some outliers."""

import math

import torch
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.fusion import Pose
from tests.support.densities import parameters


def rotations(n: int, generator: torch.Generator) -> Tensor:
    """Uniform over SO(3)."""
    normal = torch.randn(n, 3, 3, generator=generator, dtype=torch.float64)
    Q, upper = torch.linalg.qr(normal)
    Q = Q * upper.diagonal(dim1=-2, dim2=-1).sign()[:, None]
    return Q * torch.linalg.det(Q).sign()[:, None, None]


def random_problems(
    n: int, cameras: int, seed: int = 0, outliers: float = 0.1, free_axis: bool = False, rounding: float = 0.0
) -> tuple[ProjectedHuber, Pose, Tensor]:
    """Predictions, poses and true positions; a share of the predictions has errors far beyond its uncertainty.

    With a free axis they have k about 1; their errors follow it, and a rounded law of depth.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int, low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    truth = torch.randn(n, 1, 3, generator=generator, dtype=torch.float64)
    R = rotations(n * cameras, generator).unflatten(0, (n, cameras))
    z = uniform(n, cameras, low=3, high=5)
    xy_over_z = uniform(n, cameras, 2, low=-0.06, high=0.06)
    v = torch.cat([xy_over_z * z[..., None], z[..., None]], dim=-1)
    pose = Pose(R, v - (R @ truth[..., None]).squeeze(-1))

    U = rotations(n * cameras, generator).unflatten(0, (n, cameras))[..., :2, :2]
    U, _ = torch.linalg.qr(U)
    eigenvalues = uniform(n, cameras, 2, low=math.log(10), high=math.log(600)).exp()
    A = U @ eigenvalues.diag_embed() @ U.mT
    A = (A + A.mT) / 2
    a = uniform(n, cameras, low=math.log(2), high=math.log(100)).exp()
    centre = torch.zeros(n, cameras, 2, dtype=torch.float64), torch.ones(n, cameras, dtype=torch.float64)
    k = torch.randn(n, cameras, 2, generator=generator, dtype=torch.float64) if free_axis else None
    law = ProjectedHuber(*centre, A, a, k, rounding=rounding)
    error = law.rsample((), generator)  # (A^(-1) (q - k a (t - 1)), t)
    mu_xy, mu_z = xy_over_z - error[..., :2] / error[..., 2:], z / error[..., 2]
    wild = (uniform(n, cameras, low=0, high=1) < outliers).double()
    mu_xy = mu_xy + 0.1 * wild[..., None] * torch.randn(n, cameras, 2, generator=generator, dtype=torch.float64)
    mu_z = mu_z * torch.exp(0.5 * wild * torch.randn(n, cameras, generator=generator, dtype=torch.float64))
    return ProjectedHuber(mu_xy, mu_z, A, a, k, rounding=rounding), pose, truth.squeeze(1)


def columns_of(predictions: ProjectedHuber) -> tuple[Tensor, ...]:
    """The arguments of the constructor."""
    return tuple(parameters(predictions).values())

"""Mean and covariance of the product of densities, against exact moments, reweighted samples and Markov chains."""

import pytest
import torch
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.fusion import Plane, Pose, fuse
from tests.fusion.random_problems import columns_of, random_problems


def log_density(predictions: ProjectedHuber, pose: Pose, v: Tensor) -> Tensor:
    """sum_i log p_i(R_i v + t_i) at (*, problems, 3); the densities' own, nothing of fusion's."""
    return predictions.log_prob(pose.into_camera(v[..., None, :])).sum(-1)


def chains(
    predictions: ProjectedHuber, pose: Pose, start: Tensor, root: Tensor, walkers: int, steps: int
) -> tuple[Tensor, Tensor]:
    """Mean and covariance by random-walk Metropolis, its proposals 0.9 times a root of some covariance."""
    generator = torch.Generator().manual_seed(0)
    k = root.shape[-1]

    def noise() -> Tensor:
        normal = torch.randn(walkers, len(start), k, 1, generator=generator, dtype=torch.float64)
        return (root @ normal).squeeze(-1)

    v = start + noise()
    value = log_density(predictions, pose, v)
    count, first, second = 0, torch.zeros_like(start), torch.zeros(len(start), 3, 3, dtype=torch.float64)
    for step in range(steps):
        proposal = v + 0.9 * noise()
        proposed = log_density(predictions, pose, proposal)
        accepted = torch.rand(value.shape, generator=generator, dtype=torch.float64).log() < proposed - value
        v, value = torch.where(accepted[..., None], proposal, v), torch.where(accepted, proposed, value)
        if step >= steps // 5:
            offset = v - start
            count += walkers
            first += offset.sum(0)
            second += torch.einsum("wpi,wpj->pij", offset, offset)
    mean = first / count
    return start + mean, second / count - mean[:, :, None] * mean[:, None]


def ratios(covariance: Tensor, reference: Tensor) -> Tensor:
    """Predicted over sampled variance along each axis of the world."""
    return covariance.diagonal(dim1=-2, dim2=-1) / reference.diagonal(dim1=-2, dim2=-1)


def test_one_camera_has_the_moments_of_its_prediction() -> None:
    predictions, pose, _ = random_problems(300, 1, seed=20, outliers=0.0)
    predictions = ProjectedHuber(*columns_of(predictions)[:3], predictions.a.clamp_min(5.0))
    fused = fuse(predictions, pose)
    R = pose.R.squeeze(1)
    exact = R.mT @ predictions.covariance_matrix.squeeze(1) @ R
    ratio = ratios(fused.covariance, exact)
    assert (ratio.median() - 1).abs() < 0.03
    assert ((ratio - 1).abs() < 0.15).double().mean() > 0.9
    off = fused.mean - pose.into_world(predictions.mean).squeeze(1)
    assert (off.norm(dim=-1) < 0.1 * exact.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()).double().mean() > 0.95


def test_two_cameras_have_the_moments_of_reweighted_samples() -> None:
    """Exact samples of the first camera's prediction, weighted by the second's density."""
    predictions, pose, _ = random_problems(16, 2, seed=21, outliers=0.0)
    columns = columns_of(predictions)
    first, second = (ProjectedHuber(*(column[:, i] for column in columns)) for i in (0, 1))
    samples = first.rsample((20_000,), torch.Generator().manual_seed(0))
    world = Pose(pose.R[:, 0], pose.t[:, 0]).into_world(samples)
    weight = torch.softmax(second.log_prob(Pose(pose.R[:, 1], pose.t[:, 1]).into_camera(world)), dim=0)
    mean = (weight[..., None] * world).sum(0)
    centred = world - mean
    reference = torch.einsum("sp,spi,spj->pij", weight, centred, centred)
    effective = 1 / weight.square().sum(0)
    fused = fuse(predictions, pose, contradiction=0.0)
    enough = effective > 500
    assert enough.sum() > 8
    ratio = ratios(fused.covariance, reference)[enough]
    assert (ratio.median() - 1).abs() < 0.05
    assert ((ratio - 1).abs() < 0.15).double().mean() > 0.85


@pytest.mark.slow
@pytest.mark.parametrize("on_plane", [False, True])
@pytest.mark.parametrize("cameras", [1, 2, 4, 8])
def test_predicted_variances_are_those_of_markov_chains(cameras: int, on_plane: bool) -> None:
    """The one law over 200 random problems each, a tenth of the predictions being outliers."""
    predictions, pose, truth = random_problems(200, cameras, seed=22)
    normal = torch.randn(200, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    plane = Plane(normal, (normal * truth).sum(-1)) if on_plane else None
    fused = fuse(predictions, pose, plane, contradiction=0.0)
    if plane is None:
        root = torch.linalg.cholesky(fused.covariance)
    else:
        D = plane.directions
        root = D @ torch.linalg.cholesky(D.mT @ fused.covariance @ D)
    predictions = ProjectedHuber(*columns_of(predictions), validate_args=False)
    _, reference = chains(predictions, pose, fused.point, root, walkers=32, steps=4000)
    ratio = ratios(fused.covariance, reference)
    print(
        f"{cameras} cameras, {'plane' if on_plane else 'space'}: predicted over sampled variance, median "
        f"{ratio.median():.3f}, worst {ratio.min():.3f} and {ratio.max():.3f}, within 15 % "
        f"{((ratio - 1).abs() < 0.15).double().mean():.3f}"
    )
    assert (ratio.median() - 1).abs() < 0.05
    assert ((ratio - 1).abs() < 0.15).double().mean() > 0.9

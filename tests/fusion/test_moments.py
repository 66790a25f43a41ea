"""Mean and covariance of a product of densities, against closed forms, a dense grid and Markov chains."""

import pytest
import torch
from scipy import stats
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.fusion import Fused, Plane, Pose, fuse
from tests.support.random_problems import columns_of, random_problems

LEVELS = (0.5, 0.9, 0.99)
RADII = torch.from_numpy(stats.chi2.ppf(LEVELS, 3))


def log_density(predictions: ProjectedHuber, pose: Pose, v: Tensor) -> Tensor:
    """sum_i log p_i(R_i v + t_i) at (*, problems, 3), by the densities alone."""
    return predictions.log_prob(pose.into_camera(v[..., None, :])).sum(-1)


def grid_moments(predictions: ProjectedHuber, pose: Pose, fused: Fused) -> tuple[Tensor, Tensor, Tensor]:
    """Mean, covariance and coverage by the midpoint rule on 40^3 points, denser near the optimum."""
    s = torch.linspace(-3.5, 3.5, 41, dtype=torch.float64)
    s = (s[1:] + s[:-1]) / 2
    axis = torch.sinh(s)  # up to 16 standard deviations
    x = torch.cartesian_prod(axis, axis, axis)[:, None]
    log_volume = torch.cartesian_prod(*[axis.square().add(1).sqrt().log()] * 3).sum(-1)[:, None]
    v = fused.mean + (torch.linalg.cholesky(fused.covariance) @ x[..., None]).squeeze(-1)
    weight = torch.softmax(log_density(predictions, pose, v) + log_volume, dim=0)
    mean = (weight[..., None] * v).sum(0)
    covariance = torch.einsum("gp,gpi,gpj->pij", weight, v - mean, v - mean)
    solved = torch.linalg.solve(covariance, (v - mean)[..., None]).squeeze(-1)
    distance = ((v - mean) * solved).sum(-1, keepdim=True)
    return mean, covariance, (weight[..., None] * (distance <= RADII)).sum(0)


def chains(
    predictions: ProjectedHuber, pose: Pose, start: Tensor, root: Tensor, walkers: int, steps: int
) -> tuple[Tensor, Tensor]:
    """Mean and covariance by random-walk Metropolis with 0.9 times a root of some covariance as proposals."""
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
    """Ratios of the eigenvalues that are not zero."""
    ours, theirs = torch.linalg.eigvalsh(covariance), torch.linalg.eigvalsh(reference)
    return (ours / theirs)[theirs > 1e-12]


@pytest.mark.parametrize("free_axis", [False, True])
def test_one_camera_has_exactly_the_moments_of_its_prediction(free_axis: bool) -> None:
    """With the other cameras masked out too."""
    predictions, pose, _ = random_problems(50, 3, seed=20, outliers=0.0, free_axis=free_axis)
    mask = torch.zeros(50, 3, dtype=torch.bool)
    mask[:, 1] = True
    fused, R = fuse(predictions, pose, mask=mask), pose.R[:, 1]
    torch.testing.assert_close(fused.mean, pose.into_world(predictions.mean)[:, 1])
    torch.testing.assert_close(fused.covariance, R.mT @ predictions.covariance_matrix[:, 1] @ R)


@pytest.mark.parametrize(
    ("cameras", "free_axis", "rounding"), [(2, False, 0.0), (4, False, 0.0), (2, True, 0.0), (3, True, 2.0)]
)
def test_several_cameras_have_the_moments_of_a_dense_grid(cameras: int, free_axis: bool, rounding: float) -> None:
    predictions, pose, _ = random_problems(4, cameras, 21, 0.0, free_axis, rounding)
    fused = fuse(predictions, pose, contradiction=0.0)
    mean, covariance, coverage = grid_moments(predictions, pose, fused)
    error = (ratios(fused.covariance, covariance) - 1).abs()
    assert error.median() < 0.006
    assert error.max() < 0.03
    off = torch.linalg.solve(torch.linalg.cholesky(covariance), (fused.mean - mean)[..., None])
    assert off.norm(dim=(-2, -1)).max() < 0.02
    torch.testing.assert_close(fused.coverage(LEVELS), coverage, rtol=0, atol=0.008)


def test_coverage_is_the_share_of_samples_in_the_ellipsoids() -> None:
    """One camera, from a depth that is nearly unknown to one that is nearly known."""
    columns = columns_of(random_problems(1, 1, seed=23)[0])
    a = torch.tensor([[0.3], [1.0], [4.0], [20.0], [1000.0]], dtype=torch.float64)
    predictions = ProjectedHuber(*(column.expand(5, *column.shape[1:]) for column in columns[:3]), a)
    fused = fuse(predictions, Pose(torch.eye(3), torch.zeros(3)))
    samples = predictions.rsample((50_000,), torch.Generator().manual_seed(0)).squeeze(2) - fused.mean
    distance = (samples * torch.linalg.solve(fused.covariance, samples.unsqueeze(-1)).squeeze(-1)).sum(-1)
    share = (distance[..., None] <= RADII).double().mean(0)
    torch.testing.assert_close(fused.coverage(LEVELS), share, rtol=0, atol=0.008)
    assert (fused.coverage((0.9,))[2:] - 0.878).abs().max() < 0.01  # where depth is known at all


@pytest.mark.slow
@pytest.mark.parametrize("on_plane", [False, True])
@pytest.mark.parametrize("cameras", [1, 2, 4, 8])
def test_predicted_variances_are_those_of_markov_chains(cameras: int, on_plane: bool) -> None:
    """200 random problems each, a tenth of the predictions being outliers."""
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
        f"{cameras} cameras, {'plane' if on_plane else 'space'}: predicted over sampled eigenvalue, median "
        f"{ratio.median():.3f}, worst {ratio.min():.3f} and {ratio.max():.3f}, within 10 % "
        f"{((ratio - 1).abs() < 0.1).double().mean():.3f}"
    )
    assert (ratio.median() - 1).abs() < 0.02
    assert ((ratio - 1).abs() < 0.1).double().mean() > 0.9

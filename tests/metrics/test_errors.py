"""The tables' columns against a hand computation and their geometry."""

import numpy as np
import pytest
import torch
from scipy.spatial.distance import mahalanobis

from phd_exp.metrics.errors import along_true_ray, depth_error, projected_error, squared_mahalanobis


@pytest.fixture
def pairs() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    xyz = torch.randn(64, 3, generator=generator, dtype=torch.float64) + torch.tensor([0.0, 0.0, 4.0])
    return xyz, xyz + 0.1 * torch.randn(64, 3, generator=generator, dtype=torch.float64)


def test_the_two_errors_are_the_legs_of_a_right_triangle(pairs: tuple[torch.Tensor, torch.Tensor]) -> None:
    xyz, estimate = pairs
    hypotenuse = (estimate - xyz).square().sum(-1)
    legs = projected_error(xyz, estimate).square() + depth_error(xyz, estimate).square()
    torch.testing.assert_close(legs, hypotenuse)


def test_moving_along_the_true_ray_changes_depth_alone(pairs: tuple[torch.Tensor, torch.Tensor]) -> None:
    xyz, _ = pairs
    assert projected_error(xyz, 1.1 * xyz).max() < 1e-12
    torch.testing.assert_close(depth_error(xyz, 1.1 * xyz), 0.1 * xyz.norm(dim=-1))
    torch.testing.assert_close(along_true_ray(xyz, 1.1 * xyz), 1.1 * xyz)


def test_mahalanobis_distance_is_that_of_scipy_and_has_its_expectation() -> None:
    generator = torch.Generator().manual_seed(0)
    factor, noise = (torch.randn(*shape, generator=generator).double() for shape in ((3, 3), (20_000, 3)))
    covariance, error = factor @ factor.T, noise @ factor.T
    distance = squared_mahalanobis(error, covariance.expand(len(error), 3, 3))
    expected = mahalanobis(error[0].numpy(), np.zeros(3), np.linalg.inv(covariance.numpy())) ** 2
    assert float(distance[0]) == pytest.approx(expected)
    assert float(distance.mean()) == pytest.approx(3, abs=4 * np.sqrt(6 / len(error)))
    flat = torch.stack([torch.zeros(2, 2), torch.full((2, 2), torch.nan), torch.eye(2)]).double()
    one = squared_mahalanobis(torch.ones(3, 2).double(), flat)
    assert one.isnan().tolist() == [True, True, False]

"""The subgradient by which an optimum is accepted is that of the densities."""

import pytest
import torch

from phd_exp.fusion.newton import subgradient
from phd_exp.fusion.problems import Problems
from tests.support.random_problems import random_problems


@pytest.mark.parametrize(
    ("cameras", "free_axis", "rounding"), [(1, False, 0.0), (3, False, 0.0), (3, True, 0.0), (3, True, 2.0)]
)
def test_the_subgradient_is_that_of_the_densities(cameras: int, free_axis: bool, rounding: float) -> None:
    """Against autograd of sum_i -log p_i(R_i v + t_i)."""
    predictions, pose, truth = random_problems(200, cameras, 5, 0.5, free_axis, rounding)
    v = truth.clone().requires_grad_()
    value = -predictions.log_prob(pose.into_camera(v[:, None])).sum(-1)
    (gradient,) = torch.autograd.grad(value.sum(), v)
    problems = Problems.posed(predictions, pose, None, None)
    arrays, u = problems.views, (truth - problems.origin).numpy()
    found = [
        subgradient(*(array[i] for array in arrays), u[i], torch.ones(cameras).double().numpy()) for i in range(200)
    ]
    torch.testing.assert_close(torch.tensor(found)[:, 0].double(), gradient.norm(dim=-1))

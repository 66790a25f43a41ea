"""The certificate: its subgradient is that of the densities, and its bound holds."""

import hashlib
from collections.abc import Callable

import pytest
import torch
from numba import njit
from torch import Tensor

from phd_exp.fusion import fuse
from phd_exp.fusion.certificate import certify
from phd_exp.fusion.kernels import _SOURCES
from phd_exp.fusion.problems import Problems
from tests.support.random_problems import random_problems


def _loop(sources: str) -> Callable[..., None]:
    """`certify` for each problem of a batch; numba keeps what it compiled as long as the sources are these."""

    @njit(cache=True, error_model="numpy")
    def loop(slope, at_origin, a, own, u, lam, found):  # type: ignore[no-untyped-def]
        for i in range(len(a) if len(sources) > 0 else 0):
            found[i] = certify(slope[i], at_origin[i], a[i], own[i], u[i], lam[i])

    return loop  # type: ignore[no-any-return]


LOOP = _loop(hashlib.sha256(_SOURCES).hexdigest())


def certified(problems: Problems, v: Tensor, lam: Tensor) -> Tensor:
    """What `certify` returns for each problem at a world position."""
    found = torch.empty(len(v), 3, dtype=torch.float64)
    LOOP(*problems.views, (v - problems.origin).numpy(), lam.double().numpy(), found.numpy())
    return found


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
    subgradient = certified(problems, truth, torch.ones(200, cameras))[:, 0]
    torch.testing.assert_close(subgradient, gradient.norm(dim=-1))


@pytest.mark.parametrize("rounding", [0.0, 2.0])
def test_every_optimum_is_proven_within_a_micrometre(rounding: float) -> None:
    for cameras in (1, 2, 4, 8):
        predictions, pose, _ = random_problems(500, cameras, 7, free_axis=cameras % 4 == 0, rounding=rounding)
        fused = fuse(predictions, pose, contradiction=0.0)
        assert (fused.certificate < 1e-6).all()


@pytest.mark.parametrize("rounding", [0.0, 2.0])
def test_the_bound_holds_for_points_that_are_moved_off_the_optimum(rounding: float) -> None:
    """For any multipliers in [-1, 1]."""
    predictions, pose, _ = random_problems(1000, 4, seed=8, rounding=rounding)
    fused = fuse(predictions, pose, contradiction=0.0)
    problems = Problems.posed(predictions, pose, None, None)
    generator = torch.Generator().manual_seed(0)
    bounded = 0
    for step in (1e-9, 1e-7, 1e-5, 1e-3):
        direction = torch.randn(1000, 3, generator=generator, dtype=torch.float64)
        moved = fused.point + step * torch.nn.functional.normalize(direction, dim=-1)
        lam = 2 * torch.rand(1000, 4, generator=generator, dtype=torch.float64) - 1
        distance = certified(problems, moved, lam)[:, 2]
        bounded += int(distance.isfinite().sum())
        assert (distance >= step - 1e-6 - 1e-9 * step).all()
        assert (distance >= step - fused.certificate).all()
    assert bounded > 100

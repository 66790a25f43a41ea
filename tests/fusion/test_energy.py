"""What is minimised: convex, the density's, and close to its smooth stand-in."""

import pytest
import torch

from phd_exp.fusion.certificate import certify
from phd_exp.fusion.energy import energy, extended_inverse, smooth_energy
from phd_exp.fusion.problems import Problems
from tests.fusion.random_problems import random_problems

FLOOR = 1e-2


def seen(n: int, lowest: float) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    q = 3 * torch.randn(2, 1, n, generator=generator, dtype=torch.float64)
    t = lowest + 3 * torch.rand(1, 1, n, generator=generator, dtype=torch.float64)
    return torch.cat([q, t]), 10 * torch.rand(1, n, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("width", [0.0, 1e-3, 1.0])
def test_the_energy_and_its_stand_in_are_convex(width: float) -> None:
    """Along random chords; the stand-in also across t = 0."""
    (points, a) = seen(4000, -0.5 if width else 1e-3)
    one, other, a = points[..., :2000], points[..., 2000:], a[:, :2000]

    def value(at: torch.Tensor) -> torch.Tensor:
        return smooth_energy(at, a, width, FLOOR) if width else energy(at, a)

    share = torch.rand(2000, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    chord = torch.lerp(value(one), value(other), share)
    assert (value(torch.lerp(one, other, share)) <= chord * (1 + 1e-12)).all()


def test_the_stand_in_is_too_large_by_its_width_at_most() -> None:
    points, a = seen(2000, FLOOR)
    for width in (1e-6, 1e-2, 1.0):
        excess = smooth_energy(points, a, width, FLOOR) - energy(points, a)
        assert (excess >= -1e-9).all()
        assert (excess <= a * width * (1 + 1e-9) + 1e-9).all()


def test_the_continued_inverse_has_its_own_derivatives() -> None:
    t = torch.linspace(-1, 2, 61, dtype=torch.float64, requires_grad=True)
    value, first, second = extended_inverse(t, 0.3)
    (slope,) = torch.autograd.grad(value.sum(), t, create_graph=True)
    (bend,) = torch.autograd.grad(slope.sum(), t)
    torch.testing.assert_close(first, slope)
    torch.testing.assert_close(second, bend)
    far = t.detach() >= 0.3
    torch.testing.assert_close(value[far], 1 / t[far])


@pytest.mark.parametrize("cameras", [1, 3])
def test_energy_and_gradient_are_those_of_the_density(cameras: int) -> None:
    """Against autograd of sum_i -log p_i(R_i v + t_i), whose constants drop out of differences."""
    predictions, pose, truth = random_problems(200, cameras, seed=5, outliers=0.5)
    problems = Problems.posed(predictions, pose, None, None)
    views = problems.views()
    values = []
    for v in (truth, truth + 0.2):
        v = v.clone().requires_grad_()
        value = -predictions.log_prob(pose.into_camera(v[:, None])).sum(-1)
        (gradient,) = torch.autograd.grad(value.sum(), v)
        u = (v.detach() - problems.origin).T
        certificate = certify(views, u, torch.ones_like(views.a))
        torch.testing.assert_close(certificate.subgradient, gradient.norm(dim=-1))
        values.append((value.detach(), energy(views.seen(u), views.a).sum(0)))
    torch.testing.assert_close(values[0][0] - values[1][0], values[0][1] - values[1][1])

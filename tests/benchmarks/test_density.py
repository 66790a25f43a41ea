"""What the density costs: its normaliser beside quadrature, its log probability beside the network it trains."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.special import log_normaliser
from phd_exp.models.backbones import resnet

pytestmark = pytest.mark.bench
N = 100_000
POINTS = 512
BATCH = 64


def trapezoids(a: Tensor) -> Tensor:
    """log N(a) by the trapezoidal rule over log t, symmetric about the mode at t = 1, wide enough for a >= 0.1."""
    u = torch.linspace(-6, 6, POINTS, dtype=a.dtype)
    exponent = u - a[:, None] * u.abs().exp()
    return exponent.logsumexp(-1) + (u[1] - u[0]).log()


def with_gradient(function: Callable[[Tensor], Tensor], a: Tensor) -> Callable[[], Tensor]:
    def task() -> Tensor:
        argument = a.clone().requires_grad_()
        function(argument).sum().backward()
        assert argument.grad is not None
        return argument.grad

    return task


def test_the_normaliser_beside_quadrature(medians: Callable, record: Callable) -> None:
    a = torch.logspace(-1, 2, N)
    ours, theirs = with_gradient(log_normaliser, a), with_gradient(trapezoids, a)
    torch.testing.assert_close(ours(), theirs(), rtol=1e-2, atol=0)
    mine, reference = medians(ours, theirs)
    ratio = reference / mine
    what, beside = f"log N and its gradient, {N} elements", f"{1e3 * reference:.0f} ms, {POINTS} trapezoids"
    record(what, f"{1e3 * mine:.1f} ms", beside, f"{ratio:.0f} times", "100")
    assert ratio >= 100


def test_the_log_probability_beside_a_network(medians: Callable, record: Callable) -> None:
    random = torch.Generator().manual_seed(1)
    raw, f = torch.randn(BATCH, 7, generator=random), 1200 + 800 * torch.rand(BATCH, generator=random)
    xyz = torch.tensor([0.1, 0.1, 4.0]).expand(BATCH, 3)
    network, images = resnet(18), torch.randn(BATCH, 3, 112, 112, generator=random)

    def density() -> None:
        numbers = raw.clone().requires_grad_()
        prediction = ProjectedHuber.from_raw(numbers, f=f, S=224.0, mu_z0=2.5e-3, validate_args=False)
        prediction.log_prob(xyz).mean().backward()

    def step() -> None:
        network(images).features.square().mean().backward()

    mine, reference = medians(density, step)
    share = mine / reference
    what, beside = f"log_prob forward and backward, batch {BATCH}", f"{1e3 * reference:.0f} ms, resnet18 at 112 px"
    record(what, f"{1e3 * mine:.2f} ms", beside, f"{100 * share:.2f} %", "2 %")
    assert share <= 0.02

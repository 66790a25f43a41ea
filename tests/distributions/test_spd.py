"""The spectral map against an eigendecomposition, and its derivative where that has none."""

import math

import pytest
import torch
from torch.autograd import gradcheck

from phd_exp.distributions import spd

GENERIC = [(0.3, -0.7, 1.2), (-2.0, 0.5, -1.0), (3.0, 4.0, 5.0), (-0.4, 1.3, 0.6), (2.0, -9.0, -3.0)]
EQUAL = [
    (0.0, 0.0, 0.0),
    (1.5, 0.0, 1.5),
    (-1.5, 0.0, -1.5),
    (1e-9, 0.0, -1e-9),
    (-2.0, 1e-7, -2.0),
    (-2.0, 1e-20, -2.0),
    (3.0, 1e-17, 3.0),
]
ONE_ZERO = [(0.0, 0.0, -1.0), (0.0, 0.0, 1.0), (1.0, math.sqrt(2), 1.0), (-1.0, math.sqrt(2), -1.0)]


def points(*lists: list[tuple[float, ...]]) -> torch.Tensor:
    return torch.tensor([point for points in lists for point in points], dtype=torch.float64)


def reference(b: torch.Tensor) -> torch.Tensor:
    """The map by an eigendecomposition."""
    off = b[..., 1] / math.sqrt(2)
    symmetric = torch.stack([b[..., 0], off, off, b[..., 2]], dim=-1).unflatten(-1, (2, 2))
    s, U = torch.linalg.eigh(symmetric)
    return U @ torch.diag_embed(torch.where(s >= 0, s + 1, s.exp())) @ U.mT


def test_spectral_map_is_that_of_the_eigenvalues() -> None:
    b = points(GENERIC, EQUAL, ONE_ZERO)
    B, log_det = spd.spectral_map(b)
    torch.testing.assert_close(B, reference(b))
    torch.testing.assert_close(log_det, torch.linalg.slogdet(reference(b)).logabsdet)


@pytest.mark.parametrize("b", points(GENERIC, EQUAL, ONE_ZERO), ids=lambda b: str(b.tolist()))
def test_spectral_map_has_its_true_derivative(b: torch.Tensor) -> None:
    assert gradcheck(spd.spectral_map, b.requires_grad_(), atol=2e-6)


@pytest.mark.parametrize("scale", [1e-30, 1e-12, 1e-4, 1.0, 30.0])
def test_spectral_map_in_float32_is_near_float64(scale: float) -> None:
    b64 = (scale * torch.randn(200, 3, generator=torch.Generator().manual_seed(0))).double().requires_grad_()
    b32 = b64.detach().float().requires_grad_()
    for b in (b32, b64):
        B, log_det = spd.spectral_map(b)
        (B.diagonal(dim1=-2, dim2=-1).sum() + B[..., 0, 1].sum() + log_det.sum()).backward()
    (B32, log_det32), (B64, log_det64) = spd.spectral_map(b32), spd.spectral_map(b64)
    rounding = 1e-6 * max(1.0, scale)  # of an eigenvalue near 0, when the other is of the given scale
    size = B64.detach().norm(dim=(-2, -1), keepdim=True).clamp_min(1e-30)
    torch.testing.assert_close(B32.double() / size, B64 / size, rtol=0, atol=rounding)
    torch.testing.assert_close(log_det32.double(), log_det64, rtol=1e-5, atol=rounding)
    torch.testing.assert_close(b32.grad.double(), b64.grad, rtol=1e-4, atol=10 * rounding)


@pytest.mark.parametrize("middle", [-3.0, -1e-8, 0.0, 1e-8, 2.0])
def test_spectral_map_of_nearly_equal_eigenvalues_in_float32(middle: float) -> None:
    """B is I + M or e^m (I + M - m I) to first order, whatever rounding does to the eigenvalues."""
    r = torch.logspace(-30, -5, 200)
    b = torch.stack([middle + r, r, torch.full_like(r, middle)], dim=-1).requires_grad_()
    B, log_det = spd.spectral_map(b)
    slope = math.exp(min(middle, 0.0))
    torch.testing.assert_close(B[:, 0, 1], slope * b[:, 1] / math.sqrt(2), rtol=1e-4, atol=0)
    (gradient,) = torch.autograd.grad(B[:, 0, 1].sum() + log_det.sum(), b)
    expected = torch.tensor([slope / (1 + max(middle, 0.0)), 0.0, 0.0]) / slope
    expected[2], expected[1] = expected[0], slope / math.sqrt(2)
    torch.testing.assert_close(gradient, expected.expand_as(gradient), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("scale", [5, 30, 100])
def test_conditioned_raises_the_lesser_eigenvalue_alone(scale: int) -> None:
    b = scale * torch.randn(1000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    before, after = (torch.linalg.eigh(spd.spectral_map(x)[0]) for x in (b, spd.conditioned(b, 100.0)))
    far = before.eigenvalues[:, 1] > 100 * before.eigenvalues[:, 0]
    assert 0 < far.sum() < 1000
    assert torch.equal(spd.conditioned(b, 100.0)[~far], b[~far])
    greater = before.eigenvalues[far, 1]
    torch.testing.assert_close(after.eigenvalues[far], torch.stack([greater / 100, greater], -1), rtol=1e-9, atol=0)
    same = (before.eigenvectors * after.eigenvectors).sum(-2).abs()[far]
    torch.testing.assert_close(same, torch.ones_like(same))


@pytest.mark.parametrize("b", [(0.0, 0.0, 0.0), (35.0, 11.0, -9.0), (-2e3, 0.0, -2e3), (1e9, 1e9, -1e9)])
def test_conditioned_has_the_derivative_of_the_identity_in_float32(b: tuple[float, float, float]) -> None:
    raw = torch.tensor(b, requires_grad=True)
    conditioned = spd.conditioned(raw, 100.0)
    assert conditioned.isfinite().all()
    (gradient,) = torch.autograd.grad(conditioned.sum(), raw)
    assert torch.equal(gradient, torch.ones(3))


def test_positive_has_slope_one_at_zero() -> None:
    s = torch.tensor([-2.0, -1e-3, 0.0, 1e-3, 3.0], dtype=torch.float64, requires_grad=True)
    torch.testing.assert_close(spd.positive(s), torch.where(s < 0, s.exp(), s + 1))
    torch.testing.assert_close(spd.log_positive(s), spd.positive(s).log())
    for function in (spd.positive, spd.log_positive):
        (slope,) = torch.autograd.grad(function(s).sum(), s)
        assert slope[2] == 1
        assert gradcheck(function, s)


def test_linear_algebra_is_that_of_torch() -> None:
    generator = torch.Generator().manual_seed(1)
    M = reference(torch.randn(7, 3, generator=generator, dtype=torch.float64))
    x = torch.randn(7, 2, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(spd.matvec(M, x), (M @ x[..., None]).squeeze(-1))
    torch.testing.assert_close(spd.log_det(M), torch.linalg.slogdet(M).logabsdet)
    torch.testing.assert_close(spd.inverse(M, spd.log_det(M)), torch.linalg.inv(M))
    torch.testing.assert_close(spd.square(M), M @ M)

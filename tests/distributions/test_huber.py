"""The radial law of q against quadrature of r exp(-h(r))."""

import itertools
import math

import pytest
import torch
from scipy import integrate, stats
from torch.autograd import gradcheck

from phd_exp.distributions import huber


def h(r: float) -> float:
    return r * r / 2 if r <= 1 else r - 0.5


def energy_cdf_of(r: torch.Tensor) -> torch.Tensor:
    return huber.energy_cdf(torch.where(r <= 1, r.square() / 2, r - 0.5))


def radial_integral(function, low: float = 0.0, high: float = 60.0) -> float:
    """int function(r) r exp(-h(r)) dr, split where h changes."""
    borders = sorted({low, high, *(x for x in (1.0, 10.0) if low < x < high)})
    pieces = itertools.pairwise(borders)
    return sum(
        integrate.quad(lambda r: function(r) * r * math.exp(-h(r)), *piece, epsabs=1e-14)[0] for piece in pieces
    )


Z = radial_integral(lambda r: 1.0)


def test_constants_are_the_integrals() -> None:
    assert pytest.approx(math.log(2 * math.pi * Z), rel=1e-12) == huber.HUBER_LOG_NORMALISER
    assert pytest.approx(radial_integral(lambda r: r * r) / (2 * Z), rel=1e-12) == huber.HUBER_COVARIANCE
    assert pytest.approx(radial_integral(h) / Z, rel=1e-12) == huber.HUBER_MEAN_ENERGY
    assert pytest.approx(3.0764736783897990, rel=1e-15) == huber.HUBER_COVARIANCE


def test_energy_is_hubers_function_of_the_norm() -> None:
    r = torch.tensor([0.0, 1e-9, 0.5, 1.0, 1.0 + 1e-9, 3.0, 1e5], dtype=torch.float64)
    q = r[:, None] * torch.tensor([0.6, -0.8], dtype=torch.float64)
    torch.testing.assert_close(huber.huber_energy(q), torch.tensor([h(x) for x in r.tolist()], dtype=torch.float64))
    q = q[:-1].requires_grad_()
    assert gradcheck(huber.huber_energy, q)
    (gradient,) = torch.autograd.grad(huber.huber_energy(q).sum(), q)
    assert torch.equal(gradient[0], torch.zeros(2, dtype=torch.float64))


@pytest.mark.parametrize("r", [0.0, 0.3, 0.999, 1.0, 1.001, 2.5, 9.0])
def test_radial_cdf_is_the_integral(r: float) -> None:
    cdf = huber.energy_cdf(torch.tensor(h(r), dtype=torch.float64))
    assert cdf.item() == pytest.approx(radial_integral(lambda _: 1.0, 0.0, r) / Z if r else 0.0, abs=1e-13)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-14), (torch.float32, 5e-7)])
def test_radial_icdf_inverts_radial_cdf(dtype: torch.dtype, tolerance: float) -> None:
    p = torch.cat([torch.linspace(0, 1, 1001, dtype=dtype)[:-1], 1 - torch.logspace(-6, -2, 30, dtype=dtype)])
    torch.testing.assert_close(energy_cdf_of(huber.radial_icdf(p)), p, rtol=0, atol=tolerance)
    assert huber.radial_icdf(torch.tensor([0.0, 1 - torch.finfo(dtype).eps], dtype=dtype)).isfinite().all()


def test_samples_follow_the_law() -> None:
    torch.manual_seed(0)
    q = huber.sample_whitened(torch.Size([200_000]), dtype=torch.float64, device=torch.device("cpu"))
    assert stats.kstest(energy_cdf_of(q.norm(dim=-1)), "uniform").pvalue > 1e-3
    angle = torch.atan2(q[:, 1], q[:, 0]) / (2 * math.pi) + 0.5
    assert stats.kstest(angle, "uniform").pvalue > 1e-3
    torch.testing.assert_close(torch.cov(q.T), huber.HUBER_COVARIANCE * torch.eye(2).double(), rtol=0.02, atol=0.05)

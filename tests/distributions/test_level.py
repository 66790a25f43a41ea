"""The closed form of the credible level against quadrature of its definition."""

import itertools
import math

import pytest
import torch
from scipy import integrate

from phd_exp.distributions.huber import radial_cdf
from phd_exp.distributions.level import credible_level
from phd_exp.distributions.special import tail_moment

ENERGIES = [0.0, 1e-3, 0.2, 0.5, 0.51, 1.7, 6.0, 30.0]
PRECISIONS = [1e-4, 0.05, 0.7, 1.0, 4.0, 100.0, 1e6]


def tensor(value: float) -> torch.Tensor:
    return torch.tensor(value, dtype=torch.float64)


def level_by_quadrature(W: float, a: float) -> float:
    """P(h(|q|) + w <= W), integrating over the excess depth energy w in log(1 + w/a), where both sides are smooth."""
    norm = 1 + tail_moment(0, tensor(a)).item()

    def integrand(u: float) -> float:
        w = a * math.expm1(u)
        density = math.exp(-w) * (1 + math.exp(-2 * u)) / norm
        energy = max(W - w, 0.0)  # h(r) <= energy up to this r
        r = math.sqrt(2 * energy) if energy <= 0.5 else energy + 0.5
        return density * radial_cdf(tensor(r)).item() * a * math.exp(u)

    borders = [0.0, math.log1p(max(W - 0.5, 0) / a), math.log1p(W / a)]
    return sum(
        integrate.quad(integrand, low, high, epsabs=1e-12, limit=200)[0] for low, high in itertools.pairwise(borders)
    )


@pytest.mark.parametrize("a", PRECISIONS)
@pytest.mark.parametrize("W", ENERGIES)
def test_level_is_the_integral(W: float, a: float) -> None:
    assert credible_level(tensor(W), tensor(a)).item() == pytest.approx(level_by_quadrature(W, a), abs=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("a", [0.0, *PRECISIONS])
def test_level_grows_from_zero_to_one_in_float32_as_in_float64(a: float, dtype: torch.dtype) -> None:
    W = torch.cat([torch.zeros(1, dtype=dtype), torch.logspace(-2, 6, 400, dtype=dtype)])
    level = credible_level(W, torch.tensor(a, dtype=dtype))
    exact = credible_level(W.double(), torch.tensor(a, dtype=dtype).double())
    torch.testing.assert_close(level.double(), exact, rtol=0, atol=2e-6)
    assert (level.diff() >= -4 * torch.finfo(dtype).eps).all()
    assert level[0] <= 4 * torch.finfo(dtype).eps
    assert level[-1] == 1
    assert credible_level(torch.tensor(torch.inf, dtype=dtype), torch.tensor(a, dtype=dtype)) == 1

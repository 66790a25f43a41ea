"""The special functions against 40-digit arithmetic, over the whole range and on both sides of every border."""

import math
from functools import cache

import mpmath as mp
import numpy as np
import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from phd_exp.distributions import special
from phd_exp.distributions.kinked import Kinked

TOLERANCE = {torch.float64: 1e-12, torch.float32: 3e-6}  # of float32, 25 units in the last place: kernels differ
GRID = np.unique(
    np.concatenate([np.logspace(-6, 6, 49), 1 + np.linspace(-1e-3, 1e-3, 5), np.linspace(0.5, 4, 15)])
).astype(np.float32)


@cache
def exact(function, *orders: int) -> torch.Tensor:
    """A function of some orders and of each number of the grid, evaluated with 40 digits."""
    with mp.workdps(40):
        return torch.tensor([float(function(*orders, mp.mpf(x))) for x in GRID.tolist()], dtype=torch.float64)


def relative_error(value: torch.Tensor, truth: torch.Tensor) -> float:
    return float(((value.detach().double() - truth) / truth).abs().max())


def scaled_expint(n, a):
    return mp.exp(a) * mp.expint(n, a)


def tail_moment(k, a):
    return a ** (k + 1) * mp.factorial(k) * mp.hyperu(k + 1, 0, a)


def log_normaliser(a):
    return mp.log(mp.exp(-a) / a + mp.expint(2, a))


def log_normaliser_derivative(a):
    return 1 / a - 2 * (1 + 1 / a) / (1 + a * scaled_expint(2, a))


@pytest.fixture(params=[torch.float64, torch.float32], ids=["float64", "float32"])
def a(request: pytest.FixtureRequest) -> torch.Tensor:
    return torch.tensor(GRID, dtype=request.param)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5])
def test_scaled_expint(n: int, a: torch.Tensor) -> None:
    truth = exact(scaled_expint, n)
    assert relative_error(special.scaled_expint(n, a), truth) < TOLERANCE[a.dtype]


@pytest.mark.parametrize("n", [1, 2])
def test_differences_of_exponential_integrals(n: int, a: torch.Tensor) -> None:
    truth = exact(lambda x: scaled_expint(n, x) - scaled_expint(n + 1, x))
    assert relative_error(special.expint_differences(a)[n], truth) < TOLERANCE[a.dtype]


@pytest.mark.parametrize("n", [0, 6, 20])
def test_scaled_expint_refuses_orders_the_rule_was_not_built_for(n: int) -> None:
    with pytest.raises(ValueError, match=f"n: got {n}; expected 1 to 5"):
        special.scaled_expint(n, torch.ones(1))


@pytest.mark.parametrize("k", [0, 1, 2, 3])
def test_tail_moment_to_the_precision_that_moments_need(k: int, a: torch.Tensor) -> None:
    truth, value = exact(tail_moment, k), special.tail_moment(k, a)
    assert (value.double() - truth).abs().max() < TOLERANCE[a.dtype] * math.factorial(k)
    assert k > 0 or relative_error(value, truth) < TOLERANCE[a.dtype]  # g, also where it is small


def test_log_normaliser(a: torch.Tensor) -> None:
    truth = exact(log_normaliser)
    error = (special.log_normaliser(a).double() - truth).abs() / truth.abs().clamp_min(1)
    assert error.max() < TOLERANCE[a.dtype]


def test_log_normaliser_derivative(a: torch.Tensor) -> None:
    a.requires_grad_()
    (derivative,) = torch.autograd.grad(special.log_normaliser(a).sum(), a)
    assert relative_error(derivative, exact(log_normaliser_derivative)) < TOLERANCE[a.dtype]


@pytest.mark.parametrize("k", [0, 1])
def test_derivatives_are_true(k: int) -> None:
    """Of the tail moments the second ones too."""
    a = torch.tensor([0.01, 0.4, 0.99, 1.0, 1.01, 3.0, 40.0], dtype=torch.float64, requires_grad=True)
    assert gradcheck(lambda a: special.tail_moment(k, a), a)
    assert gradgradcheck(lambda a: special.tail_moment(k, a), a)
    for n in (k + 1, k + 3):
        assert gradcheck(lambda a, n=n: special.scaled_expint(n, a), a)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_normaliser_where_a_underflows(dtype: torch.dtype) -> None:
    log_a = torch.tensor([-1e4, -200.0, -60.0, 60.0], dtype=dtype, requires_grad=True)
    value = Kinked(log_a).log_normaliser
    (derivative,) = torch.autograd.grad(value.sum(), log_a)
    torch.testing.assert_close(value[:3], -log_a[:3])
    torch.testing.assert_close(value[3], -log_a[3] + np.log(2))
    torch.testing.assert_close(derivative, -torch.ones_like(log_a))


def test_signed_log1p_has_its_true_derivative_at_zero() -> None:
    x = torch.tensor([-2.0, -1e-3, 0.0, 1e-3, 5.0], dtype=torch.float64, requires_grad=True)
    log_a = torch.tensor([-3.0, 0.0, 0.5, 4.0, 1.0], dtype=torch.float64, requires_grad=True)
    torch.testing.assert_close(special.signed_log1p(x, log_a), x.sign() * torch.log1p(x.abs() / log_a.exp()))
    assert gradcheck(special.signed_log1p, (x, log_a))
    assert gradcheck(special.signed_log1p, (x, log_a[:1]))


def test_signed_log1p_stays_finite_where_a_underflows() -> None:
    eps, x = torch.finfo(torch.float32).eps, torch.tensor([-1e4, 0.0, 1e4], requires_grad=True)
    value = special.signed_log1p(x, torch.tensor(-1e4))
    (derivative,) = torch.autograd.grad(value.sum(), x)
    torch.testing.assert_close(value, x.detach().sign() * (np.log(1e4) + 1e4))
    torch.testing.assert_close(derivative, torch.tensor([1e-4, 1 / eps, 1e-4]))


def test_validation_before_training_leaves_no_inference_tensors_behind() -> None:
    """In a data type that no other test uses, so that its constants are built here."""
    a = torch.tensor([0.5, 2.0], dtype=torch.bfloat16, requires_grad=True)
    with torch.inference_mode():
        special.scaled_expint(2, a)
    special.scaled_expint(2, a).sum().backward()

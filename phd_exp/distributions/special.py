"""The special functions of the depth law: exponential integrals, their tail moments and the log normaliser.

Everything rests on two schemes that meet at a = 1 and have no cancellation in any precision.

- a <= 1: the series e^a E_1(a) = sum_k (psi(k+1) - log a) a^k / k!, then n e^a E_(n+1)(a) = 1 - a e^a E_n(a) upwards.
- a > 1: one Gauss rule sum_i w_i F(s_i) for int_0^inf e^(-s) F(s) ds with F(s) = (1 + s/a)^(-n). Its weights are positive.

Source: DLMF 8.19 and 6.6 for the series; the rule is an own derivation, see `_GAUSS_RULE`.
"""

import math
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

# (s_i, w_i) of the rational Gauss rule (Gautschi) for the weight e^(-s) on (0, inf): exact for p(s) / prod_j (1 + s/a_j)
# with deg p <= 23 and 16 poles a_j spaced evenly in log a from 0.9 to 4. With F as above its relative error is below
# 5e-14 for n <= 5 and all a >= 1, infinity included. tests/distributions/test_special.py derives it anew with mpmath.
_GAUSS_RULE = (
    (0.020955799700610195, 0.053004349135899005),
    (0.11348662257710466, 0.1187370397099964),
    (0.29281990517817627, 0.17126171793973244),
    (0.5823985197385662, 0.1986938260864264),
    (1.0191418143501489, 0.19007645019945924),
    (1.6569497057325368, 0.14521991858200345),
    (2.571307376154859, 0.082882669575380877),
    (3.8655475985982563, 0.032001819210138486),
    (5.6815860434369666, 0.0072863783153259668),
    (8.2251594215758661, 0.00080435200175969541),
    (11.841461318214777, 0.000031269396581665841),
    (17.330737121104064, 0.00000020984729637289678),
)
_EULER_GAMMA = 0.5772156649015328606
_SERIES_TERMS = 19  # the first term left out is below 2e-17 for a <= 1
_CHUNK = 1 << 14
_LARGEST_N = 5  # the highest order for which the Gauss rule was built


def scaled_expint(n: int, a: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """The scaled exponential integral e^a E_n(a) = int_0^inf e^(-a s) (1 + s)^(-n) ds for any integer n up to 5 and a > 0.

    Relative error below 1e-12 in float64 and 1e-6 in float32 for a in [1e-6, 1e6].

    Raises:
        ValueError: n > 5.

    Source: DLMF 8.19; checked against mpmath in tests/distributions/test_special.py.
    """
    if n > _LARGEST_N:
        raise ValueError(f"n must be at most {_LARGEST_N}, but is {n}")
    if n <= 0:
        return _elementary(-n, a)
    small = a <= 1
    below, above = torch.where(small, a, 1), torch.where(small, 1, a)  # each scheme sees only what it is for
    (moment,) = _expect(above, (0, n))
    return torch.where(small, _series(n, below)[-1], moment / above)


def tail_moment(k: int, a: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """The k-th moment of the lower tail of the depth law, J_k(a) = int_0^inf s^k e^(-s) (1 + s/a)^(-k-2) ds, k >= 0.

    J_0 is the paper's g(a) = a e^a E_2(a), and J_k(inf) = k!. The family is closed under differentiation:
    dJ_k/da = (k + 2) J_(k+1)(a) / a^2, so derivatives of any order are exact. a may have underflowed to 0.

    Source: own derivation (expand s^k around s + a); checked against mpmath in tests/distributions/test_special.py.
    """
    value: Tensor = _TailMoment.apply(a, k)
    return value


def log_scaled_normaliser(log_a: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """The log normaliser without its leading term, log(e^a N(a)) = log(1 + g(a)) - log a, as a function of log a.

    Finite, with finite derivatives, for every log a: a may underflow or be large enough to swallow the other terms.

    Source: paper, section "Computing normalizing factor".
    """
    return torch.log1p(tail_moment(0, log_a.exp())) - log_a


def log_normaliser(a: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """The log normaliser of the depth law, log N(a) with N(a) = int_0^inf e^(-a max(t, 1/t)) dt = e^(-a)/a + E_2(a), a > 0.

    Relative error of d log N/da below 1e-12 in float64 and 1e-6 in float32 for a in [1e-6, 1e6]; the error of log N
    itself is below that times max(1, |log N|).

    Source: paper, section "Computing normalizing factor".
    """
    return log_scaled_normaliser(a.log()) - a


def signed_log1p(x: Float[Tensor, "*#batch"], log_a: Float[Tensor, "*#batch"]) -> Float[Tensor, "*#batch"]:
    """sign(x) log(1 + |x|/a), smooth at x = 0 with the derivative 1 / (a + |x|); finite where a underflows.

    Where a + |x| is below the machine's epsilon the derivative in x is held at its inverse, so that it stays finite.

    Source: own derivation (log nu_z as a function of w_2, in one formula for both branches of the paper's activation);
    checked in tests/distributions/test_special.py.
    """
    value: Tensor = _SignedLog1p.apply(x, log_a)
    return value


class _SignedLog1p(torch.autograd.Function):
    """sign(x) log(1 + |x|/a): autograd would differentiate |x| and log|x| at 0, and get 0 or NaN instead of 1/a."""

    @staticmethod
    def forward(ctx: torch.autograd.function.FunctionCtx, x: Tensor, log_a: Tensor) -> Tensor:
        ctx.save_for_backward(x, log_a)
        log_ratio = x.abs().log() - log_a
        return x.sign() * torch.logaddexp(torch.zeros_like(log_ratio), log_ratio)

    @staticmethod
    def backward(ctx: torch.autograd.function.FunctionCtx, grad: Tensor) -> tuple[Tensor, Tensor]:
        x, log_a = ctx.saved_tensors  # type: ignore[attr-defined]
        slope = 1 / (log_a.exp() + x.abs()).clamp_min(torch.finfo(x.dtype).eps)
        return (grad * slope).sum_to_size(x.shape), (-grad * x * slope).sum_to_size(log_a.shape)


class _TailMoment(torch.autograd.Function):
    """J_k with the derivative (k + 2) J_(k+1) / a^2, where autograd would differentiate both schemes and is slow."""

    @staticmethod
    def forward(ctx: torch.autograd.function.FunctionCtx, a: Tensor, k: int) -> Tensor:
        value, derivative = _tail_moment_and_derivative(k, a)
        ctx.save_for_backward(a, derivative)
        ctx.k = k  # type: ignore[attr-defined]
        return value

    @staticmethod
    def backward(ctx: torch.autograd.function.FunctionCtx, grad: Tensor) -> tuple[Tensor, None]:
        a, derivative = ctx.saved_tensors  # type: ignore[attr-defined]
        if torch.is_grad_enabled():  # a derivative of this derivative is wanted: climb the ladder
            k = ctx.k  # type: ignore[attr-defined]
            derivative = (k + 2) * tail_moment(k + 1, a) / a.square()
        return grad * derivative, None


def _tail_moment_and_derivative(k: int, a: Tensor) -> tuple[Tensor, Tensor]:
    """J_k(a) and dJ_k/da, without cancellation in either."""
    small = a <= 1
    below, above = torch.where(small, a, 1), torch.where(small, 1, a)
    e = _series(k + 3, below)[1:]  # e^a E_n for n = 2, ..., k + 3
    value_below = below ** (k + 1) * _difference(k, e)
    derivative_below = (k + 2) * below**k * _difference(k + 1, e)
    value_above, next_above = _expect(above, (k, k + 2), (k + 1, k + 3))
    derivative_above = (k + 2) * next_above / above.square()
    return torch.where(small, value_below, value_above), torch.where(small, derivative_below, derivative_above)


def _elementary(k: int, a: Tensor) -> Tensor:
    """e^a E_(-k)(a) = k!/a^(k+1) sum_(j <= k) a^j/j! for k >= 0, by Horner's rule."""
    value = torch.ones_like(a)
    for j in range(1, k + 1):
        value = 1 + value * j / a
    return value / a


def _series(n: int, a: Tensor) -> list[Tensor]:
    """e^a E_1(a), ..., e^a E_n(a) for 0 <= a <= 1; at a = 0 the first is finite where it should be infinite."""
    log_a = a.clamp_min(torch.finfo(a.dtype).tiny).log()
    digamma = [math.fsum([-_EULER_GAMMA, *(1 / j for j in range(1, k + 1))]) for k in range(_SERIES_TERMS)]
    regular = torch.zeros_like(a)  # sum_k psi(k + 1) a^k / k!
    for k in reversed(range(_SERIES_TERMS)):
        regular = regular * a + digamma[k] / math.factorial(k)
    e = [regular - log_a * a.exp()]
    for j in range(1, n):
        e.append((1 - a * e[-1]) / j)
    return e


def _difference(k: int, values: list[Tensor]) -> Tensor:
    """The alternating difference sum_j (-1)^j binomial(k, j) values[j]."""
    total = values[0]
    for j in range(1, k + 1):
        total = total + (-1) ** j * math.comb(k, j) * values[j]
    return total


def _expect(a: Tensor, *terms: tuple[int, int]) -> tuple[Tensor, ...]:
    """int_0^inf e^(-s) s^k (1 + s/a)^(-n) ds for each (k, n), by the Gauss rule, for a >= 1."""
    s, w = _gauss_rule(a.dtype, a.device)
    # a chunk stays in the processor's cache; sums rather than matmul, which autocast would round to bfloat16
    us = [1 / (1 + s / part) for part in a.reshape(-1).split(_CHUNK)]
    return tuple(torch.cat([(w * s**k * u**n).sum(0) for u in us]).reshape(a.shape) for k, n in terms)


@cache
def _gauss_rule(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Nodes and weights as columns; kept, because copying them to a GPU would make it wait."""
    columns = torch.tensor(_GAUSS_RULE, dtype=dtype, device=device)
    return columns[:, :1].clone(), columns[:, 1:].clone()

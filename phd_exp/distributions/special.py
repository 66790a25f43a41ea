"""The special functions of the depth law: exponential integrals, their tail moments and the log normaliser.

All use two schemes that meet at a = 1. Neither loses digits to cancellation, in any precision.

- a <= 1: the series e^a E_1(a) = sum_k (psi(k + 1) - log a) a^k / k!, then n E_(n+1)(a) = e^(-a) - a E_n(a) upwards.
- a > 1: one Gauss rule sum_i w_i F(s_i) for int_0^inf e^(-s) F(s) ds with F(s) = s^k (1 + s/a)^(-n). All w_i are
  positive.

Source: DLMF 6.6 and 8.19 for the series; the rule is an own derivation, see `GAUSS_RULE`.
"""

import math
import sys
from collections.abc import Callable
from functools import cache
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

# (s_i, w_i) of the rational Gauss rule (Gautschi) for the weight e^(-s) on (0, inf): exact for
# p(s) / prod_j (1 + s/a_j) with deg p <= 25 and 19 poles a_j spaced evenly in log a from 0.9 to 8. For k = 0 its
# relative error is below 2e-16 at n = 2, 3e-14 at n = 4 and 2e-13 at n = 5, for all a >= 1, infinity included.
# tests/distributions/test_special.py derives it anew with mpmath.
GAUSS_RULE = (
    (0.020171831813756392, 0.051009036140987848),
    (0.10875679026524802, 0.11371716148653708),
    (0.27834286810847623, 0.16305456419243933),
    (0.54701994620586973, 0.18894354682676692),
    (0.9422202189343656, 0.18329191521711674),
    (1.5024709205077837, 0.14665210879617855),
    (2.2799892399192145, 0.092843661302222856),
    (3.3445568251146698, 0.043631642007195898),
    (4.7898343414272994, 0.013924689321330476),
    (6.7453979133328553, 0.0026670546441355827),
    (9.4042292661769616, 0.00025556198597809285),
    (13.100199618633182, 0.0000090003759473549687),
    (18.622310304378326, 0.000000057703163267050501),
)
_EULER_GAMMA = 0.5772156649015328606
_DIGAMMA = [math.fsum([-_EULER_GAMMA, *(1 / j for j in range(1, k + 1))]) for k in range(19)]
SERIES = tuple(psi / math.factorial(k) for k, psi in enumerate(_DIGAMMA))
"""psi(k + 1)/k! of the series; the first term left out is below 2e-17 for a <= 1."""
_CHUNK = 1 << 13
_LARGEST_N = 5  # the highest order for which the Gauss rule was built


def scaled_expint(n: int, a: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """The scaled exponential integral e^a E_n(a) = int_0^inf e^(-a s) (1 + s)^(-n) ds, for n from 1 to 5 and a > 0.

    Relative error below 1e-12 in float64 and 1e-6 in float32 for a in [1e-6, 1e6].

    Raises:
        ValueError: n is below 1 or above 5.

    Source: DLMF 8.19; checked against mpmath in tests/distributions/test_special.py.
    """
    if not 1 <= n <= _LARGEST_N:
        raise ValueError(f"n: got {n}; expected 1 to {_LARGEST_N}")
    small = a <= 1
    # masked, because a clamp has no gradient at a = 1, where a network starts
    below, above = a.masked_fill(~small, 1), a.masked_fill(small, 1)
    return torch.where(small, _series(n, below)[n - 1], _by_rule(above, (0, n))[0] / above)


def expint_differences(a: Float[Tensor, "*batch"]) -> tuple[Float[Tensor, "*batch"], ...]:
    """e^a E_2(a), and the differences e^a (E_1 - E_2) and e^a (E_2 - E_3), none of which loses digits, for a > 0.

    Source: own derivation, E_n - E_(n+1) = int_0^inf s e^(-a s) (1 + s)^(-n-1) ds; checked against mpmath in
    tests/distributions/test_special.py.
    """
    small = a <= 1
    below, above = a.masked_fill(~small, 1), a.masked_fill(small, 1)
    one, two, three = _series(3, below)
    second, first, third = _by_rule(above, (0, 2), (1, 2), (1, 3))
    pairs = (two, second / above), (one - two, first / above / above), (two - three, third / above / above)
    return tuple(torch.where(small, *pair) for pair in pairs)


def tail_moment(k: int, a: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """The k-th moment of the lower tail of the depth law, J_k(a) = int_0^inf s^k e^(-s) (1 + s/a)^(-k-2) ds, k >= 0.

    J_0 is the paper's g(a) = a e^a E_2(a), and J_k(inf) = k!. From dJ_k/da = (k + 2) J_(k+1)(a) / a^2 follow the
    derivatives of every order. a may underflow to 0.

    Source: own derivation (differentiate under the integral); checked against mpmath in
    tests/distributions/test_special.py.
    """
    if torch.compiler.is_compiling():  # which takes no Function with forward mode, and fuses what autograd does
        return _tail_moment_and_derivative(k, a)[0]
    value: Tensor = _TailMoment.apply(a, k)[0]
    return value


def log_normaliser(a: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """The log normaliser of the depth law for a > 0, N(a) = int_0^inf e^(-a max(t, 1/t)) dt = e^(-a)/a + E_2(a).

    Relative error of d log N/da below 1e-12 in float64 and 1e-6 in float32 for a in [1e-6, 1e6]; the error of log N
    itself is below that times max(1, |log N|).

    Source: paper, section "Computing normalizing factor".
    """
    return torch.log1p(tail_moment(0, a)) - a.log() - a


def weighted_integral(F: Callable[[Tensor], Tensor], like: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """int_0^inf e^(-s) F(s) ds by the Gauss rule, where F has its singularities at s <= -1; for the batch of `like`.

    F takes nodes s of shape `(nodes, 1, ..., 1)` and returns `(nodes, *batch)`.
    """
    s, w = (constant.view(-1, *[1] * like.ndim) for constant in _constants(like)[:2])
    return (w * F(s)).sum(0)


def signed_log1p(x: Float[Tensor, "*#batch"], log_a: Float[Tensor, "*#batch"]) -> Float[Tensor, "*#batch"]:
    """sign(x) log(1 + |x|/a), smooth at x = 0 with the derivative 1 / (a + |x|); finite where a underflows.

    The derivative in x is bounded by the inverse of the machine epsilon, below which |x| and a count as small.

    Source: own derivation (log nu_z as a function of w_2, for both branches of the paper's activation); checked in
    tests/distributions/test_special.py.
    """
    sign, eps = 2 * (x >= 0).to(x) - 1, torch.finfo(x.dtype).eps
    size = sign * x  # |x|, with the derivative 1 at 0
    near = size < eps
    log_ratio = size.masked_fill(near, 1).log() - log_a
    far = torch.logaddexp(torch.zeros_like(log_ratio), log_ratio)
    return sign * torch.where(near, torch.log1p(size / log_a.exp().clamp_min(eps)), far)


class _TailMoment(torch.autograd.Function):
    """J_k and the derivative (k + 2) J_(k+1) / a^2, where autograd would differentiate both schemes and is slow."""

    @staticmethod
    def forward(a: Tensor, k: int) -> tuple[Tensor, Tensor]:
        if a.numel() <= _CHUNK:
            return _tail_moment_and_derivative(k, a)
        # piecewise, so that the arrays of a chunk fit into a processor's cache
        chunks = [_tail_moment_and_derivative(k, chunk) for chunk in a.reshape(-1).split(_CHUNK)]
        value, derivative = (torch.cat(parts).reshape(a.shape) for parts in zip(*chunks, strict=True))
        return value, derivative

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, int], output: tuple[Tensor, Tensor]) -> None:
        (a, ctx.k), (_, derivative) = inputs, output
        ctx.mark_non_differentiable(derivative)
        ctx.save_for_backward(a, derivative)
        ctx.save_for_forward(a)

    @staticmethod
    def backward(ctx: Any, grad: Tensor, _: Tensor) -> tuple[Tensor, None]:
        a, derivative = ctx.saved_tensors
        if torch.is_grad_enabled():  # a derivative of this derivative is wanted
            derivative = _TailMoment.derivative(a, ctx.k)
        return grad * derivative, None

    @staticmethod
    def vmap(_: Any, in_dims: tuple[int, None], a: Tensor, k: int) -> tuple[tuple[Tensor, Tensor], tuple[int, int]]:
        value, derivative = _TailMoment.apply(a, k)
        return (value, derivative), (in_dims[0], in_dims[0])

    @staticmethod
    def derivative(a: Tensor, k: int) -> Tensor:
        return (k + 2) * tail_moment(k + 1, a) / a.square().clamp_min(torch.finfo(a.dtype).tiny)

    @staticmethod
    def jvp(ctx: Any, a_dot: Tensor, _: None) -> tuple[Tensor, None]:
        _refuse_nested_forward_mode()
        (a,) = ctx.saved_tensors
        return a_dot * _TailMoment.derivative(a, ctx.k), None


def _refuse_nested_forward_mode() -> None:
    """Raise NotImplementedError where torch would return a derivative of zero instead of a second derivative."""
    if getattr(sys.modules.get("torch._functorch.eager_transforms"), "JVP_NESTING", 1) > 1:
        raise NotImplementedError(
            "derivatives: got forward mode within forward mode, of which torch ignores one in an autograd.Function; "
            "expected one of them at most; use torch.func.hessian"
        )


def _tail_moment_and_derivative(k: int, a: Tensor) -> tuple[Tensor, Tensor]:
    """J_k(a) and dJ_k/da, without cancellation in either."""
    small = a <= 1
    below, above = a.clamp_max(1), a.clamp_min(1)
    e = _series(k + 3, below)[1:]  # e^a E_n for n = 2, ..., k + 3
    value_below = below ** (k + 1) * _difference(k, e)
    derivative_below = (k + 2) * below**k * _difference(k + 1, e)
    value_above, next_above = _by_rule(above, (k, k + 2), (k + 1, k + 3))
    derivative_above = (k + 2) * next_above / above.square()
    value = torch.where(small, value_below, value_above)
    return value, torch.where(small, derivative_below, derivative_above)


def _series(n: int, a: Tensor) -> list[Tensor]:
    """e^a E_1(a), ..., e^a E_n(a) for 0 <= a <= 1; at a = 0 the first is finite where it should be infinite."""
    log_a = a.clamp_min(torch.finfo(a.dtype).tiny).log()
    e = [_regular(a) - log_a * a.exp()]
    for j in range(1, n):
        e.append((1 - a * e[-1]) / j)
    return e


def _regular(a: Tensor) -> Tensor:
    """sum_k psi(k + 1) a^k / k!."""
    coefficients = _constants(a)[2]
    if torch.compiler.is_exporting():  # three operations of a graph instead of 36
        return (torch.stack(coefficients) * a[..., None] ** torch.arange(len(coefficients)).to(a)).sum(-1)
    *lower, total = coefficients  # Horner's rule
    for coefficient in reversed(lower):
        total = torch.addcmul(coefficient, total, a)
    return total


def _difference(k: int, values: list[Tensor]) -> Tensor:
    """The alternating difference sum_j (-1)^j binomial(k, j) values[j]."""
    total = values[0]
    for j in range(1, k + 1):
        total = total + (-1) ** j * math.comb(k, j) * values[j]
    return total


def _by_rule(a: Tensor, *terms: tuple[int, int]) -> list[Tensor]:
    """int_0^inf s^k e^(-s) (1 + s/a)^(-n) ds for each (k, n), by the Gauss rule, for a >= 1."""
    s, w = (constant.view(-1, *[1] * a.ndim) for constant in _constants(a)[:2])
    u = a / (s + a)
    # a sum stays exact under autocast, where a matmul would be done in bfloat16
    return [(u**n).mul_(w * s**k).sum(0) for k, n in terms]


def _constants(a: Tensor) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
    """Nodes and weights of the Gauss rule and psi(k + 1)/k! for the series, of the type and on the device of a."""
    if torch.compiler.is_compiling():
        return _build_constants(a.dtype, a.device)  # the compiler keeps them
    with torch.inference_mode(False):  # validation may come first, and training needs ordinary tensors
        return _kept_constants(a.dtype, a.device)


def _build_constants(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
    s, w = torch.tensor(GAUSS_RULE, dtype=dtype, device=device).unbind(-1)
    return s.contiguous(), w.contiguous(), torch.tensor(SERIES, dtype=dtype, device=device).unbind()


_kept_constants = cache(_build_constants)  # copying them to a GPU in every call would make it wait

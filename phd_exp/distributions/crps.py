"""The continuous ranked probability score of the depth law: int (F(u) - 1[u >= t])^2 du = E|T - t| - E|T - T'|/2.

With the excess energy w of t (depth.py), g = J_0(a) and J_1(a) of `tail_moment`, both parts have closed forms in the
exponential integrals. Everything here is in units of 1/a, the width of the law, so that nothing cancels where a is
large and nothing underflows where it is small.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.distributions.depth import LARGEST_ENERGY, depth_energy
from phd_exp.distributions.special import scaled_expint, tail_moment, weighted_integral


def crps_beyond_distance(
    log_t: Float[Tensor, "*#batch"], log_a: Float[Tensor, "*#batch"]
) -> Float[Tensor, "*#batch"]:
    """a (CRPS(t) - |t - 1|): what the score adds to the distance from the mode, in units of 1/a.

    a (E|T - t| - |t - 1|) is (2 e^(-w) - 1 + J_1) / (1 + g) beyond the mode and
    (1 - J_1 + 2 e^(-w) t^4 J_1(a + w)) / (1 + g) before it; a E|T - T'|/2 is `half_mean_difference`.

    Source: own derivation (partial moments of the excess energy); checked against quadrature and samples in
    tests/distributions/test_crps.py.
    """
    a = log_a.exp()
    w = depth_energy(log_t, log_a).clamp_max(LARGEST_ENERGY)  # beyond, the law has no mass left
    j_0, j_1 = tail_moment(0, a), tail_moment(1, a)
    decay = torch.exp(-w)
    near = torch.exp(4 * log_t.clamp_max(0)) * tail_moment(1, a + w)
    twice_beyond = torch.where(log_t > 0, 2 * decay - 1 + j_1, 1 - j_1 + 2 * decay * near)
    return twice_beyond / (1 + j_0) - half_mean_difference(log_a)


def half_mean_difference(log_a: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """a E|T - T'|/2 = a int F (1 - F) dt = (1/2 + g + (1 + g) J_1 - Q) / (1 + g)^2 for independent depths T and T'.

    Q(a) = int_0^inf e^(-2w) (1 + w/a)^(-6) g(a + w)^2 dw = a^3 e^(2a) int_1^inf v^(-4) E_2(a v)^2 dv.

    Source: own derivation; checked against quadrature in tests/distributions/test_crps.py.
    """
    a = log_a.exp()
    j_0, j_1 = tail_moment(0, a), tail_moment(1, a)
    small = a <= 1
    near, far = (
        _squared_tail_by_parts(a.masked_fill(~small, 1)),
        _squared_tail_by_rule(a.masked_fill(small, 1)),
    )
    return (0.5 + j_0 + (1 + j_0) * j_1 - torch.where(small, near, far)) / (1 + j_0).square()


def _squared_tail_by_rule(a: Tensor) -> Tensor:
    """Q(a) for a >= 1, with s = 2 w by the Gauss rule for the weight e^(-s)."""
    return weighted_integral(lambda s: (a / (a + s / 2)) ** 6 * tail_moment(0, a + s / 2) ** 2, a) / 2


def _squared_tail_by_parts(a: Tensor) -> Tensor:
    """Q(a) for a <= 1, by parts from (E_2)' = -E_1 and (E_1)' = -e^(-x)/x; all integrals are from 1 to infinity.

    V = int v^(-2) e^(-a v) E_1 dv = e^(-a) E_1 - a E_1^2/2 - E_2(2a),  U = int v^(-2) E_1^2 dv = E_1^2 - 2 V,
    R = int v^(-3) E_2 E_1 dv = (E_2 E_1 - a U - E_3(2a) + a V)/2,      Q = a^3 e^(2a) (E_2^2 - 2 a R)/3.
    """
    e_1, e_2 = scaled_expint(1, a), scaled_expint(2, a)  # each with its factor e^a, products with e^(2a)
    V = e_1 - a * e_1.square() / 2 - scaled_expint(2, 2 * a)
    U = e_1.square() - 2 * V
    R = (e_2 * e_1 - a * U - scaled_expint(3, 2 * a) + a * V) / 2
    return a**3 * (e_2.square() - 2 * a * R) / 3

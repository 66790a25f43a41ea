"""The depth law of t = z / mu_z, with density exp(-a max(t, 1/t)) / N(a), as functions of log t and log a.

Logarithms keep every quantity finite where a or t underflows. All formulas follow from two facts. The excess energy
w = a (max(t, 1/t) - 1) has the density e^(-w) / (1 + g(a)) on the side t > 1, and (1 + w/a)^(-2) times that on the
side t < 1. The moments are those of `tail_moment`, J_k(a) = int_0^inf s^k e^(-s) (1 + s/a)^(-k-2) ds.

The continuous ranked probability score is int (F(u) - 1[u >= t])^2 du = E|T - t| - E|T - T'|/2. Both terms have
closed forms in the exponential integrals. In units of 1/a, the width of the law, nothing cancels where a is large and
nothing underflows where a is small.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.distributions.special import scaled_expint, signed_log1p, tail_moment, weighted_integral

LARGEST_ENERGY = 700.0  # the excess energy above which 1 + e^(-w) rounds to 1 in any precision
_NEWTON_STEPS = 6  # to rounding from any a and p; test_icdf_inverts_cdf covers both tails


def depth_energy(log_t: Float[Tensor, "*#batch"], log_a: Float[Tensor, "*#batch"]) -> Float[Tensor, "*#batch"]:
    """The excess energy a (max(t, 1/t) - 1) >= 0, zero at the mode t = 1.

    Source: paper, section "Projected Huber distribution".
    """
    return _energy_of_distance(log_t.abs(), log_a)


def _energy_of_distance(distance: Tensor, log_a: Tensor) -> Tensor:
    """a (e^distance - 1), where a may underflow and e^distance overflow."""
    return torch.exp(log_a + distance) * -torch.expm1(-distance)


def depth_cdf(log_t: Float[Tensor, "*#batch"], log_a: Float[Tensor, "*#batch"]) -> Float[Tensor, "*#batch"]:
    """The probability of depths up to t.

    P(z/mu_z <= t) = t^2 g(a/t) e^(-w) / (1 + g(a)) for t <= 1 and 1 - e^(-w) / (1 + g(a)) beyond, with the excess
    energy w of t.

    Source: own derivation (the normaliser's integral with another limit); checked in
    tests/distributions/test_depth.py.
    """
    near = log_t <= 0
    below, above = log_t.masked_fill(~near, 0), log_t.masked_fill(near, 0)
    log_norm = torch.log1p(tail_moment(0, log_a.exp()))
    decay = torch.exp(2 * below - _energy_of_distance(-below, log_a) - log_norm)
    lower = decay * tail_moment(0, torch.exp(log_a - below))
    return torch.where(near, lower, -torch.expm1(-_energy_of_distance(above, log_a) - log_norm))


def depth_icdf(p: Float[Tensor, "*#batch"], log_a: Float[Tensor, "*#batch"]) -> Float[Tensor, "*#batch"]:
    """The log t with P(z/mu_z <= t) = p, for p in [0, 1]; differentiable once for p in (0, 1), in p and log a.

    Above the mode t = 1 + w/a with e^(-w) = (1 - p)(1 + g(a)). Below it l = -log t solves
    a (e^l - 1) + 2 l - log g(a e^l) = -log(p (1 + g(a))). The left side is increasing and convex: its derivative is
    1 / (e^x E_2(x)) at x = a e^l, which lies between x + 1 and x + 2 and grows. Newton's method starts from the upper
    bound that x + 1 gives and only goes down; its last step is taken with gradients, which makes them those of the
    implicit function.

    Source: own derivation; round trip and gradients checked in tests/distributions/test_depth.py.
    """
    p, log_a = torch.broadcast_tensors(p, log_a)
    a = log_a.exp()
    g = tail_moment(0, a)
    zero = p == 0
    p = p.masked_fill(zero, 0.5)  # whose result is replaced below
    below = p * (1 + g) < g
    w = -torch.log1p(-p.masked_fill(below, 0.5)) - torch.log1p(g)
    upper = signed_log1p(w.masked_fill(below, 1), log_a)
    log_e_2 = scaled_expint(2, a).log()
    drop = log_a + log_e_2 - torch.log1p(g) - p.masked_fill(~below, 0.5).log()  # log(P(t < 1) / p)
    log_t = torch.where(below, -_solve_lower(drop.masked_fill(~below, 1), log_a, log_e_2), upper)
    return log_t.masked_fill(zero, -torch.inf)


def _solve_lower(drop: Tensor, log_a: Tensor, log_e_2: Tensor) -> Tensor:
    """The l >= 0 with a (e^l - 1) + l - log(E_2(a e^l) / E_2(a)) = drop, E_2 scaled; gradients by the last step."""
    with torch.no_grad():
        distance = torch.minimum(drop, signed_log1p(drop, log_a))
        for _ in range(_NEWTON_STEPS):
            distance = _newton_step(distance, drop, log_a, log_e_2).clamp_min(0)
    return _newton_step(distance, drop, log_a, log_e_2)


def _newton_step(distance: Tensor, drop: Tensor, log_a: Tensor, log_e_2: Tensor) -> Tensor:
    e_2 = scaled_expint(2, torch.exp(log_a + distance))
    excess = _energy_of_distance(distance, log_a) + distance - e_2.log() + log_e_2 - drop
    return distance - excess * e_2


def depth_excess_moments(log_a: Float[Tensor, "*batch"]) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Mean and variance of a (t - 1), the depth beyond the mode in units of the law's width.

    The mean is (1 - J_1) / (1 + J_0), the variance (2 + J_2) / (1 + J_0) less its square. Where a is large,
    M_2/M_0 - (M_1/M_0)^2 of the paper's raw moments would lose every digit, and 1 - J_1, about 6/a, is the integral
    of s e^(-s) (1 - u^3) with u = a/(a + s).

    Source: own derivation (moments around the mode); checked against mpmath in tests/distributions/test_depth.py.
    """
    a = log_a.exp()
    j_0, j_1, j_2 = (tail_moment(k, a) for k in range(3))
    small = a <= 1
    above = a.masked_fill(small, 1)
    far = weighted_integral(lambda s: s.square() / (above + s) * _three_powers(above / (above + s)), above)
    mean = torch.where(small, 1 - j_1, far) / (1 + j_0)
    return mean, (2 + j_2) / (1 + j_0) - mean.square()


def _three_powers(u: Tensor) -> Tensor:
    return 1 + u + u.square()


def inverse_depth_shortfall(a: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """1 - E[1/t] = int_0^inf s^2 e^(-s) (1 + s/a)^(-2) ds / (a^2 (1 + g(a))), about 1/a^2 where a is large.

    With y the shortfall, Var[1/t] = y (2 - y), because E[1/t^2] = 1. For a <= 1 the integral over a^2 is
    1 + g - 2 a e^a E_1(a), which would cancel where a is large.

    Source: own derivation (moments around the mode); checked against mpmath in tests/distributions/test_depth.py.
    """
    small = a <= 1
    below, above = a.masked_fill(~small, 1), a.masked_fill(small, 1)
    near = 1 + tail_moment(0, below) - 2 * below * scaled_expint(1, below)
    far = weighted_integral(lambda s: (s / (above + s)).square(), above)
    return torch.where(small, near, far) / (1 + tail_moment(0, a))


def depth_mean_energy(log_a: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """The mean excess energy E[w] = 2 (1 + a) e^a E_3(a) / (1 + g(a)).

    Source: own derivation (E[max(t, 1/t)] = -d log N/da, rearranged so that nothing cancels where a is large);
    checked in tests/distributions/test_depth.py.
    """
    a = log_a.exp()
    return 2 * (1 + a) * scaled_expint(3, a) / (1 + tail_moment(0, a))


def crps_beyond_distance(
    log_t: Float[Tensor, "*#batch"], log_a: Float[Tensor, "*#batch"]
) -> Float[Tensor, "*#batch"]:
    """a (CRPS(t) - |t - 1|): the score minus the distance from the mode, in units of 1/a.

    a (E|T - t| - |t - 1|) is (2 e^(-w) - 1 + J_1) / (1 + g) beyond the mode and
    (1 - J_1 + 2 e^(-w) t^4 J_1(a + w)) / (1 + g) before it; a E|T - T'|/2 is `half_mean_difference`.

    Source: own derivation (partial moments of the excess energy); checked against quadrature and samples in
    tests/distributions/test_crps.py.
    """
    a = log_a.exp()
    w = depth_energy(log_t, log_a).clamp_max(LARGEST_ENERGY)  # no mass lies beyond
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
    below, above = a.masked_fill(~small, 1), a.masked_fill(small, 1)
    Q = torch.where(small, _squared_tail_by_parts(below), _squared_tail_by_rule(above))
    return (0.5 + j_0 + (1 + j_0) * j_1 - Q) / (1 + j_0).square()


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

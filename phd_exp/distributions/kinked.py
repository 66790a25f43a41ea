"""The paper's law of depth: t = z / mu_z has the density exp(-a max(t, 1/t)) / N(a).

All formulas follow from two facts. The excess energy w = a (max(t, 1/t) - 1) has the density e^(-w) / (1 + g(a)) on
the side t > 1, and (1 + w/a)^(-2) times that on the side t < 1. The moments are those of `tail_moment`,
J_k(a) = int_0^inf s^k e^(-s) (1 + s/a)^(-k-2) ds, with J_0 = g. In units of 1/a, the width of the law, nothing
cancels where a is large and nothing underflows where a is small.
"""

import math
from dataclasses import dataclass
from typing import final

import torch
from torch import Tensor

from phd_exp.distributions.depth_law import DepthLaw, Numbers
from phd_exp.distributions.huber import RADIAL_NORMALISER
from phd_exp.distributions.special import scaled_expint, tail_moment, weighted_integral

LARGEST_ENERGY = 700.0  # the excess energy above which 1 + e^(-w) rounds to 1 in any precision
_NEWTON_STEPS = 6  # to rounding from any a and p; the round trip of a test covers both tails


@final
@dataclass(frozen=True)
class Kinked(DepthLaw):
    """The law of t with the energy a max(t, 1/t).

    Args:
        log_a: log of the precision of z.

    Source: paper, section "Projected Huber distribution"; own derivations, checked against mpmath and quadrature in
    tests/distributions/test_depth_laws.py.
    """

    log_a: Numbers

    @property
    def _mass(self) -> Numbers:
        """1 + g, of which 1 lies beyond the mode."""
        return 1 + tail_moment(0, self.log_a.exp())

    def energy(self, log_t: Numbers) -> Numbers:
        return _energy_of_distance(log_t.abs(), self.log_a)

    def farthest_log_t(self, energy: Numbers) -> Numbers:
        return torch.log1p(energy / self.log_a.exp())

    @property
    def log_normaliser(self) -> Numbers:
        """log(e^a N(a)) = log(1 + g(a)) - log a; finite, with finite derivatives, also where a underflows.

        Source: paper, section "Computing normalizing factor".
        """
        return torch.log1p(tail_moment(0, self.log_a.exp())) - self.log_a

    def level(self, energy: Numbers) -> Numbers:
        """P(h(|q|) + w <= W) for an energy W >= 0.

        With Z = 1 + e^(-1/2), G(y) = P(h(|q|) > y) is (e^(-1/2) + e^(-y))/Z up to y = 1/2 and (y + 3/2) e^(-y)/Z
        beyond. Hence 1 - level = P(w > W) + int_0^W e^(-w) (1 + (1 + w/a)^(-2)) G(W - w) dw / (1 + g(a)), which has
        a closed form on each side of w = X, where G changes.
        """
        a = self.log_a.exp()
        a = a.clamp_min(torch.finfo(a.dtype).tiny ** 0.5)  # its square must not underflow
        W = energy.clamp_max(-2 * math.log(torch.finfo(a.dtype).tiny))  # beyond, the level is 1 to the last bit
        X = (W - 0.5).clamp_min(0)  # w < X: the projection's energy W - w lies on the linear branch of h
        tail_W, tail_X = _lower_tail(W, a), _lower_tail(X, a)
        linear = X * (W + 1.5) - X.square() / 2 + _lower_linear(X, W + 1.5, a)
        flat = (W - X) * (1 + a / (a + W) * a / (a + X))
        rest = math.exp(-0.5) * (torch.exp(-X) + tail_X - torch.exp(-W) - tail_W)
        outside = torch.exp(-W) + tail_W + (torch.exp(-W) * (linear + flat) + rest) / RADIAL_NORMALISER
        return (1 - outside / (1 + tail_moment(0, a))).clamp(0, 1)

    def cdf(self, log_t: Numbers) -> Numbers:
        """t^2 g(a/t) e^(-w) / (1 + g(a)) for t <= 1 and 1 - e^(-w) / (1 + g(a)) beyond, with the energy w of t."""
        near = log_t <= 0
        below, above = log_t.masked_fill(~near, 0), log_t.masked_fill(near, 0)
        log_mass = self._mass.log()
        decay = torch.exp(2 * below - _energy_of_distance(-below, self.log_a) - log_mass)
        lower = decay * tail_moment(0, torch.exp(self.log_a - below))
        return torch.where(near, lower, -torch.expm1(-_energy_of_distance(above, self.log_a) - log_mass))

    def icdf(self, p: Numbers) -> Numbers:
        """Above the mode t = 1 + w/a with e^(-w) = (1 - p)(1 + g(a)); below it by Newton's method.

        There l = -log t solves a (e^l - 1) + 2 l - log g(a e^l) = -log(p (1 + g(a))). The left side is increasing and
        convex: its derivative is 1 / (e^x E_2(x)) at x = a e^l, which lies between x + 1 and x + 2 and grows. The
        steps start from the upper bound that x + 1 gives and only go down; the last one is taken with gradients,
        which makes them those of the implicit function.
        """
        p, log_a = torch.broadcast_tensors(p, self.log_a)
        a = log_a.exp()
        g = tail_moment(0, a)
        zero = p == 0
        p = p.masked_fill(zero, 0.5)  # whose result is replaced below
        below = p * (1 + g) < g
        w = -torch.log1p(-p.masked_fill(below, 0.5)) - torch.log1p(g)
        upper = _log_of_1_plus(w.masked_fill(below, 1), log_a)
        log_e_2 = scaled_expint(2, a).log()
        drop = log_a + log_e_2 - torch.log1p(g) - p.masked_fill(~below, 0.5).log()  # log(P(t < 1) / p)
        log_t = torch.where(below, -_solve_lower(drop.masked_fill(~below, 1), log_a, log_e_2), upper)
        return log_t.masked_fill(zero, -torch.inf)

    @property
    def excess_moments(self) -> tuple[Numbers, Numbers]:
        """(1 - J_1) / (1 + J_0), and (2 + J_2) / (1 + J_0) less its square.

        Where a is large, M_2/M_0 - (M_1/M_0)^2 of the paper's raw moments would lose every digit, and 1 - J_1, about
        6/a, is the integral of s e^(-s) (1 - u^3) with u = a/(a + s).
        """
        a = self.log_a.exp()
        j_1, j_2 = tail_moment(1, a), tail_moment(2, a)
        small, _, above = _parts(a)
        far = weighted_integral(lambda s: s.square() / (above + s) * _three_powers(above / (above + s)), above)
        mean = torch.where(small, 1 - j_1, far) / self._mass
        return mean, (2 + j_2) / self._mass - mean.square()

    @property
    def inverse_moments(self) -> tuple[Numbers, Numbers]:
        """y and y (2 - y), because E[1/t^2] = 1, with y = int_0^inf s^2 e^(-s) (1 + s/a)^(-2) ds / (a^2 (1 + g(a))).

        y is about 1/a^2 where a is large. For a <= 1 the integral over a^2 is 1 + g - 2 a e^a E_1(a), which would
        cancel where a is large.
        """
        small, below, above = _parts(self.log_a.exp())
        near = 1 + tail_moment(0, below) - 2 * below * scaled_expint(1, below)
        far = weighted_integral(lambda s: (s / (above + s)).square(), above)
        y = torch.where(small, near, far) / self._mass
        return y, y * (2 - y)

    @property
    def mean_energy(self) -> Numbers:
        """2 (1 + a) e^a E_3(a) / (1 + g(a)): E[max(t, 1/t)] = -d log N/da, so that nothing cancels."""
        a = self.log_a.exp()
        return 2 * (1 + a) * scaled_expint(3, a) / self._mass

    def crps_beyond_distance(self, log_t: Numbers) -> Numbers:
        """a (E|T - t| - |t - 1|) is (2 e^(-w) - 1 + J_1) / (1 + g) beyond the mode and
        (1 - J_1 + 2 e^(-w) t^4 J_1(a + w)) / (1 + g) before it.
        """
        a = self.log_a.exp()
        w = self.energy(log_t).clamp_max(LARGEST_ENERGY)  # no mass lies beyond
        j_1, decay = tail_moment(1, a), torch.exp(-w)
        near = torch.exp(4 * log_t.clamp_max(0)) * tail_moment(1, a + w)
        twice_beyond = torch.where(log_t > 0, 2 * decay - 1 + j_1, 1 - j_1 + 2 * decay * near)
        return twice_beyond / self._mass - self.half_mean_difference

    @property
    def half_mean_difference(self) -> Numbers:
        """a E|T - T'|/2 = a int F (1 - F) dt = (1/2 + g + (1 + g) J_1 - Q) / (1 + g)^2 for independent T and T'.

        Q(a) = int_0^inf e^(-2w) (1 + w/a)^(-6) g(a + w)^2 dw = a^3 e^(2a) int_1^inf v^(-4) E_2(a v)^2 dv.
        """
        a = self.log_a.exp()
        j_0, j_1 = tail_moment(0, a), tail_moment(1, a)
        small, below, above = _parts(a)
        Q = torch.where(small, _squared_tail_by_parts(below), _squared_tail_by_rule(above))
        return (0.5 + j_0 + (1 + j_0) * j_1 - Q) / (1 + j_0).square()


def _parts(a: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Whether a <= 1, and a with 1 in place of the others, on each side: formulas change there."""
    small = a <= 1
    return small, a.masked_fill(~small, 1), a.masked_fill(small, 1)


def _energy_of_distance(distance: Tensor, log_a: Tensor) -> Tensor:
    """a (e^distance - 1), where a may underflow and e^distance overflow."""
    return torch.exp(log_a + distance) * -torch.expm1(-distance)


def _log_of_1_plus(x: Tensor, log_a: Tensor) -> Tensor:
    """log(1 + x/a) for x >= 0, where a may underflow."""
    return torch.logaddexp(torch.zeros_like(x), x.clamp_min(torch.finfo(x.dtype).tiny).log() - log_a)


def _solve_lower(drop: Tensor, log_a: Tensor, log_e_2: Tensor) -> Tensor:
    """The l >= 0 with a (e^l - 1) + l - log(E_2(a e^l) / E_2(a)) = drop, E_2 scaled; gradients by the last step."""
    with torch.no_grad():
        distance = torch.minimum(drop, _log_of_1_plus(drop, log_a))
        for _ in range(_NEWTON_STEPS):
            distance = _newton_step(distance, drop, log_a, log_e_2).clamp_min(0)
    return _newton_step(distance, drop, log_a, log_e_2)


def _newton_step(distance: Tensor, drop: Tensor, log_a: Tensor, log_e_2: Tensor) -> Tensor:
    e_2 = scaled_expint(2, torch.exp(log_a + distance))
    excess = _energy_of_distance(distance, log_a) + distance - e_2.log() + log_e_2 - drop
    return distance - excess * e_2


def _three_powers(u: Tensor) -> Tensor:
    return 1 + u + u.square()


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


def _lower_tail(w: Tensor, a: Tensor) -> Tensor:
    """int_w^inf e^(-x) (1 + x/a)^(-2) dx = e^(-w) (a / (a + w))^2 g(a + w)."""
    return torch.exp(-w) * (a / (a + w)).square() * tail_moment(0, a + w)


def _lower_linear(X: Tensor, top: Tensor, a: Tensor) -> Tensor:
    """int_0^X (top - w) (1 + w/a)^(-2) dw = top a X / (a + X) - a^2 (log(1 + X/a) - X / (a + X))."""
    return top * X * (a / (a + X)) - a.square() * _log_remainder(X / a)


def _log_remainder(y: Tensor) -> Tensor:
    """log(1 + y) - y / (1 + y) for y >= 0, about y^2/2 where y is small, with full relative accuracy."""
    # with u = y/(2 + y), log(1 + y) = 2 artanh u and y/(1 + y) = 2 u/(1 + u); their linear terms drop out by hand
    small = y < 0.5
    u = y.masked_fill(~small, 0)
    u = u / (2 + u)
    series = torch.zeros_like(u)
    for k in reversed(range(1, 12)):
        series = (series + 1 / (2 * k + 1)) * u.square()
    large = y.masked_fill(small, 1)
    return torch.where(small, 2 * u * (series + u / (1 + u)), torch.log1p(large) - large / (1 + large))

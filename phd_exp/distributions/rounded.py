"""The law of depth with a rounded mode.

The energy a max(t, 1/t) of the paper has a kink at the mode. With l = log t and r > 0 the excess energy is here

    a (cosh l - 1) + sqrt(a^2 sinh^2 l + r^2) - r,

which is a (max(t, 1/t) - 1) for r = 0. Where a is large it depends on s = a (t - 1) alone: it is about s^2/(2 r) near
the mode and |s| - r far from it. Up to a constant, the energy is the least w >= a max(t, 1/t) with
(w - a t) (w - a/t) >= r^2, hence convex in t: the density stays log-concave, with the same support and limits.

Integrals over t become integrals over x with a sinh l = min(a, r) sinh x, where the integrands are smooth for every
a. They end where the energy is 50, and are computed by Gauss's rule.

Source: own derivation; checked against mpmath in tests/distributions/test_depth_laws.py.
"""

import math
from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple, final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.distributions.depth_law import DepthLaw, Numbers
from phd_exp.distributions.huber import energy_cdf
from phd_exp.distributions.kinked import Kinked

_LEAST_LOG_A = -13.0
_SHARE = 0.95  # of the largest exponent, up to which e^l is computed
_LARGEST_ENERGY = 50.0
_NODES, _PART, _LEVEL = 64, 40, 40  # nodes for the whole law, one of its tails, and each part of a level
_NEWTON_STEPS, _CLOSEST_STEPS = 3, 20
Points = Float[Tensor, "*#batch points"]


@final
@dataclass(frozen=True)
class Rounded(DepthLaw):
    """The law of t with a rounded mode.

    Args:
        log_a: log of the precision of z; less than -13 counts as -13.
        r: half the width of the rounded part, in units of 1/a, positive.
    """

    log_a: Numbers
    r: float

    def energy(self, log_t: Numbers) -> Numbers:
        # without y^2, which could overflow: with y = a sinh l = r sinh u, a (cosh l - 1) = y tanh(l/2) and
        # sqrt(y^2 + r^2) - r = y tanh(u/2)
        y, l = self._scaled_sinh(log_t)
        return y * (torch.tanh(l / 2) + torch.tanh(torch.asinh(y / self.r) / 2))

    def farthest_log_t(self, energy: Numbers) -> Numbers:
        # from sqrt(a^2 (c^2 - 1) + r^2) = energy + a + r - a c with c = cosh l
        a = self._a.squeeze(-1)
        excess = energy * (energy + 2 * self.r) / (2 * a * (a + self.r + energy))  # c - 1
        return _arcosh_of_1_plus(excess)

    @property
    def log_normaliser(self) -> Numbers:
        return self._mass.log() - self.log_a.clamp_min(_LEAST_LOG_A)

    def level(self, energy: Numbers) -> Numbers:
        # to 1e-7 for a of at least 1e-5
        # up to the first bound, the energy that is left for the projection is beyond the knee of h
        W = energy.clamp_max(_LARGEST_ENERGY)
        bounds = self._x(self.farthest_log_t((W - 0.5).clamp_min(0))), self._x(self.farthest_log_t(W))
        inside = torch.zeros_like(W * self._mass)
        for low, high in zip((torch.zeros_like(bounds[0]), bounds[0]), bounds, strict=True):
            points, weight = self._between(low[..., None], high[..., None], _LEVEL)
            both = weight * (1 + torch.exp(-2 * points.log_t))  # t and 1/t
            inside = inside + (both * energy_cdf((W[..., None] - points.energy).clamp_min(0))).sum(-1)
        return (inside / self._mass).clamp(0, 1)

    def cdf(self, log_t: Numbers) -> Numbers:
        tail = self._tail(self._x(log_t))[1].sum(-1) / self._mass
        return torch.where(log_t < 0, tail, 1 - tail)

    def icdf(self, p: Numbers) -> Numbers:
        """By Newton's method for the log of the probability of the tail, which is concave in t.

        The last step is taken with gradients, which makes them those of the implicit function.
        """
        is_end = (p == 0) | (p == 1)
        inner = p.masked_fill(is_end, 0.5)
        with torch.no_grad():
            law = Rounded(self.log_a, self.r)  # whose cached values need no gradient
            x = law._start(inner)
            for _ in range(_NEWTON_STEPS):
                x = law._nearer(x, inner)
        log_t = self._at(self._nearer(x, inner)[..., None]).log_t.squeeze(-1)
        return torch.where(is_end, torch.where(p == 0, -torch.inf, torch.inf), log_t)

    @property
    def excess_moments(self) -> tuple[Numbers, Numbers]:
        # of both signs of l together, a (t - 1) t is 2 a (sinh^2 l + (cosh l - 1) cosh l): its terms do not cancel
        points = self._whole[0]
        y, excess = points.y, self._excess(points.y)
        both = y.square() / self._a + (excess - y) * (1 + (y / self._a).square()).sqrt()
        mean = (self._share * torch.exp(-points.log_t) * both).sum(-1)
        return mean, (self._share * (excess - mean[..., None]).square()).sum(-1)

    @property
    def inverse_moments(self) -> tuple[Numbers, Numbers]:
        return self._moments(-torch.expm1(-self._whole[0].log_t))

    @property
    def mean_energy(self) -> Numbers:
        return self._moments(self._whole[0].energy)[0]

    def crps_beyond_distance(self, log_t: Numbers) -> Numbers:
        """With S = a (T - 1), E|S - s| - |s| is 2 E[(s - S)_+] + E[S] before the mode and 2 E[(S - s)_+] - E[S]
        beyond it; E|S - S'|/2 is E[S (2 F(S) - 1)].
        """
        at = self._x(log_t)
        tail, weight = self._tail(at)
        here = self._excess(self._at(at[..., None]).y)
        apart = (weight * (self._excess(tail.y) - here)).sum(-1).abs() / self._mass
        s, share = self._excess(self._whole[0].y), self._share
        mean = (share * s).sum(-1)
        _, nodes_weight, integral = _gauss(_NODES, self._a)
        below = (share / nodes_weight) @ integral.mT
        return 2 * apart + torch.where(log_t < 0, mean, -mean) - (share * s * (2 * below - 1)).sum(-1)

    # points: x has the same batch dimensions as the law, and a last one

    @cached_property
    def _a(self) -> Tensor:
        return self.log_a.clamp_min(_LEAST_LOG_A).exp()[..., None]

    def _scaled_sinh(self, log_t: Numbers) -> tuple[Numbers, Numbers]:
        """a sinh l and l; an l at which that would overflow is replaced by a smaller one."""
        farthest = _SHARE * math.log(torch.finfo(log_t.dtype).max) - self.log_a.clamp_min(0)
        l = torch.minimum(torch.maximum(log_t, -farthest), farthest)
        return self._a.squeeze(-1) * l.sinh(), l

    @property
    def _scale(self) -> Tensor:
        return self._a.clamp_max(self.r)

    @property
    def _end(self) -> Tensor:
        """The x beyond which the energy is more than 50."""
        return _arcosh_of_1_plus(_LARGEST_ENERGY / self._scale)

    # functions of y = a sinh l

    def _rise(self, y: Tensor) -> Tensor:
        """a (cosh l - 1)."""
        squared = y.square()
        return squared / (self._a + (self._a.square() + squared).sqrt())

    def _excess(self, y: Tensor) -> Tensor:
        """a (t - 1)."""
        return y + self._rise(y)

    def _energy(self, y: Tensor) -> Tensor:
        """The excess energy."""
        squared = y.square()
        return self._rise(y) + squared / (self.r + (self.r**2 + squared).sqrt())

    def _slope(self, y: Tensor) -> Tensor:
        """Its derivative by log a."""
        squared = y.square()
        return self._rise(y) + squared / (self.r**2 + squared).sqrt()

    def _curvature(self, y: Tensor) -> Tensor:
        """Its second derivative by log a."""
        squared = y.square()
        R_squared = self.r**2 + squared
        return self._rise(y) + squared / R_squared.sqrt() * (2 - squared / R_squared)

    def _at(self, x: Points) -> "_Points":
        # by exp and log, because runtimes of exported graphs have hyperbolic functions in float32 alone
        grown, shrunk = x.exp(), (-x).exp()
        y = self._scale * (grown - shrunk) / 2
        cosh_l = (1 + (y / self._a).square()).sqrt()
        size = y.abs() / self._a
        log_t = torch.log1p(size + size.square() / (1 + cosh_l))  # arsinh
        log_t, energy = torch.where(y < 0, -log_t, log_t), self._energy(y)
        by_x = self._scale * (grown + shrunk) / 2 / cosh_l  # a dl/dx
        return _Points(y, log_t, energy, torch.exp(log_t - energy) * by_x)

    def _x(self, log_t: Numbers) -> Numbers:
        x = torch.asinh(self._scaled_sinh(log_t)[0][..., None] / self._scale)
        return torch.minimum(torch.maximum(x, -self._end), self._end).squeeze(-1)

    def _between(self, low: Points, high: Points, n: int) -> tuple["_Points", Points]:
        """n points of Gauss's rule, and weights that sum to the integral of the density from low to high."""
        nodes, weight, _ = _gauss(n, self._a)
        half = (high - low) / 2
        points = self._at(low + half * (nodes + 1))
        return points, points.density * weight * half

    def _tail(self, x: Numbers) -> tuple["_Points", Points]:
        """Points and weights from x to the end on its side of the mode."""
        x = x[..., None]
        below = x < 0
        return self._between(torch.where(below, -self._end, x), torch.where(below, x, self._end), _PART)

    @cached_property
    def _whole(self) -> tuple["_Points", Points]:
        return self._between(-self._end, self._end, _NODES)

    @cached_property
    def _mass(self) -> Numbers:
        return self._whole[1].sum(-1)

    @cached_property
    def _share(self) -> Points:
        """The shares of the probability at the points of the whole law."""
        return self._whole[1] / self._mass[..., None]

    def _moments(self, values: Points) -> tuple[Numbers, Numbers]:
        mean = (self._share * values).sum(-1)
        return mean, (self._share * (values - mean[..., None]).square()).sum(-1)

    def _start(self, p: Numbers) -> Numbers:
        """The x of the node that is nearest to the probability p."""
        before = (self._share.cumsum(-1) - self._share / 2 < p[..., None]).sum(-1).clamp_max(_NODES - 1)
        return self._end.squeeze(-1) * _gauss(_NODES, self._a)[0][before]

    def _nearer(self, x: Numbers, p: Numbers) -> Numbers:
        """One step of Newton's method to the x with the probability p."""
        tail, density = self._tail(x)[1].sum(-1), self._at(x[..., None]).density.squeeze(-1)
        below = x < 0
        step = tail / density * (torch.where(below, p, 1 - p) * self._mass / tail).log()
        end = self._end.squeeze(-1).detach()
        return torch.minimum(torch.maximum(x + torch.where(below, step, -step), -end), end)

    @property
    def nodes(self) -> tuple[Points, Points]:
        """log t at nodes, and their shares of the probability."""
        return self._whole[0].log_t, self._share

    def closest_to(self, log_t: Points, share: Points) -> tuple[Numbers, Numbers]:
        """The log mu_z and log a of the law with the highest mean log density over depths of these shares.

        By Newton's method from log mu_z = 0 and log a; the energy is convex in log mu_z. The derivatives are those of
        J = E[energy] + log mu_z + `log_normaliser`, with l the log of depth over mu_z, s = a sinh l, c = a cosh l and
        R = sqrt(s^2 + r^2).
        """
        place, log_a = torch.zeros_like(self.log_a), self.log_a
        for _ in range(_CLOSEST_STEPS):
            law = Rounded(log_a, self.r)
            own = law._whole[0].y
            l = log_t - place[..., None]
            far, near = law._a * l.exp() / 2, law._a * (-l).exp() / 2
            s, c = far - near, far + near
            R = (s.square() + self.r**2).sqrt()
            by_place = 1 - (share * (s + s * c / R)).sum(-1)
            mean_slope, varied = law._moments(law._slope(own))
            by_a = (share * law._slope(s)).sum(-1) - mean_slope
            bend = (share * (c + (c.square() * self.r**2 / R.square() + s.square()) / R)).sum(-1)
            both = -(share * (s + s * c / R * (2 - (s / R).square()))).sum(-1)
            bend_a = varied + (share * law._curvature(s)).sum(-1) - law._moments(law._curvature(own))[0]
            bend_a = bend_a.maximum(varied / 2)
            determinant = (bend * bend_a - both.square()).clamp_min(bend * bend_a / 2)
            place = place - ((bend_a * by_place - both * by_a) / determinant).clamp(-0.5, 0.5)
            log_a = log_a - ((bend * by_a - both * by_place) / determinant).clamp(-0.5, 0.5)
        return place, log_a


def depth_law(log_a: Numbers, rounding: float) -> DepthLaw:
    """The law of depth with this precision; the paper's for a rounding of 0."""
    return Rounded(log_a, rounding) if rounding else Kinked(log_a)


class _Points(NamedTuple):
    """Points x of each law: a sinh(log t), log t, the excess energy, and exp(-energy) a dt/dx."""

    y: Points
    log_t: Points
    energy: Points
    density: Points


def _arcosh_of_1_plus(x: Tensor) -> Tensor:
    """For x >= 0."""
    return torch.log1p(x + (x * (x + 2)).sqrt())


def _gauss(n: int, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    nodes, weights, integral = (torch.from_numpy(values).to(like) for values in _rule(n))
    return nodes, weights, integral


@cache
def _rule(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gauss's rule on [-1, 1]: n nodes and weights, and the matrix from f to its integrals from -1 to each node.

    The last is exact for polynomials of degree below n: f has the Legendre coefficients (k + 1/2) sum w P_k f, and
    the integral of P_k is (P_(k+1) - P_(k-1)) / (2 k + 1).
    """
    nodes, weights = np.polynomial.legendre.leggauss(n)
    P = np.polynomial.legendre.legvander(nodes, n)  # nodes, degrees 0 to n
    before = np.concatenate([-np.ones((n, 1)), P[:, : n - 1]], axis=1)  # P_(-1) = -1 makes the integral of P_0 x + 1
    of_degree = (P[:, 1:] - before) / (2 * np.arange(n) + 1)
    return nodes, weights, of_degree @ ((np.arange(n) + 0.5)[:, None] * P[:, :n].T * weights)

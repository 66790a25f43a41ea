"""Credible levels: how much probability the smallest region of highest density around the mode holds."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.distributions.huber import RADIAL_NORMALISER
from phd_exp.distributions.special import tail_moment


def credible_level(energy: Float[Tensor, "*#batch"], a: Float[Tensor, "*#batch"]) -> Float[Tensor, "*#batch"]:
    """P(h(|q|) + a (max(t, 1/t) - 1) <= W) for an energy W >= 0 above the mode's, in [0, 1].

    The excess depth energy w has the density e^(-w) (1 + (1 + w/a)^(-2)) / (1 + g(a)), one term for each side of the
    mode. With Z = 1 + e^(-1/2), G(y) = P(h(|q|) > y) is (e^(-1/2) + e^(-y))/Z up to y = 1/2 and (y + 3/2) e^(-y)/Z
    beyond. Hence 1 - level = P(w > W) + int_0^W e^(-w) (1 + (1 + w/a)^(-2)) G(W - w) dw / (1 + g(a)), which has a
    closed form on each side of w = X, where G changes.

    Source: own derivation; checked against quadrature in tests/distributions/test_level.py.
    """
    a = a.clamp_min(torch.finfo(a.dtype).tiny ** 0.5)  # its square must not underflow
    W = energy.clamp_max(-2 * math.log(torch.finfo(a.dtype).tiny))  # beyond, the level is 1 to the last bit
    X = (W - 0.5).clamp_min(0)  # w < X: the projection's energy W - w lies on the linear branch of h
    tail_W, tail_X = _lower_tail(W, a), _lower_tail(X, a)
    linear = X * (W + 1.5) - X.square() / 2 + _lower_linear(X, W + 1.5, a)
    flat = (W - X) * (1 + a / (a + W) * a / (a + X))
    rest = math.exp(-0.5) * (torch.exp(-X) + tail_X - torch.exp(-W) - tail_W)
    outside = torch.exp(-W) + tail_W + (torch.exp(-W) * (linear + flat) + rest) / RADIAL_NORMALISER
    return (1 - outside / (1 + tail_moment(0, a))).clamp(0, 1)


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

"""As `phd_exp.distributions.level`, of what the cameras see of an optimum."""

import math
from typing import no_type_check

import numpy as np
from numba import prange

from phd_exp.distributions.huber import RADIAL_NORMALISER
from phd_exp.distributions.special import GAUSS_RULE, SERIES
from phd_exp.fusion.compiled import TINY, compiled, on_all_cores
from phd_exp.fusion.compiled.energy import energy
from phd_exp.fusion.compiled.linear import seen_of

_RULE, _SERIES = np.array(GAUSS_RULE), np.array(SERIES)
_FLATTEST, _HIGHEST = math.sqrt(TINY), -2 * math.log(TINY)


@on_all_cores
@no_type_check
def surprise(slope, at_origin, a, u, level):
    """Fills level with the credible level of each u in each view; 0 in a view that takes no part."""
    for i in prange(len(a)):
        for c in range(a.shape[1]):
            level[i, c] = 0.0
            if a[i, c] > 0:
                q_x, q_y, t = seen_of(slope[i, c], at_origin[i, c], u[i])
                level[i, c] = credible_level(energy(q_x, q_y, t, a[i, c]) - a[i, c], a[i, c])


@compiled
@no_type_check
def credible_level(energy, a):
    """Of an energy above the mode's."""
    a = max(a, _FLATTEST)
    W = min(energy, _HIGHEST)
    X = max(W - 0.5, 0.0)
    tail_W, tail_X = _lower_tail(W, a), _lower_tail(X, a)
    top = W + 1.5
    linear = X * top - X * X / 2 + top * X * (a / (a + X)) - a * a * _log_remainder(X / a)
    flat = (W - X) * (1 + a / (a + W) * a / (a + X))
    rest = math.exp(-0.5) * (math.exp(-X) + tail_X - math.exp(-W) - tail_W)
    outside = math.exp(-W) + tail_W + (math.exp(-W) * (linear + flat) + rest) / RADIAL_NORMALISER
    return min(max(1 - outside / (1 + tail_moment(a)), 0.0), 1.0)


@compiled
@no_type_check
def _lower_tail(w, a):
    return math.exp(-w) * (a / (a + w)) ** 2 * tail_moment(a + w)


@compiled
@no_type_check
def _log_remainder(y):
    if y >= 0.5:
        return math.log1p(y) - y / (1 + y)
    u = y / (2 + y)
    series = 0.0
    for k in range(11, 0, -1):
        series = (series + 1 / (2 * k + 1)) * u * u
    return 2 * u * (series + u / (1 + u))


@compiled
@no_type_check
def tail_moment(a):
    """J_0 of `phd_exp.distributions.special`."""
    total = 0.0
    if a > 1:
        for i in range(len(_RULE)):
            total += _RULE[i, 1] * (a / (_RULE[i, 0] + a)) ** 2
        return total
    for k in range(len(_SERIES) - 1, -1, -1):
        total = total * a + _SERIES[k]
    return a * (1 - a * (total - math.log(max(a, TINY)) * math.exp(a)))

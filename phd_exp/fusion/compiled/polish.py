"""As `phd_exp.fusion.polish`."""

import math
from typing import no_type_check

import numpy as np
from numba import prange

from phd_exp.fusion.compiled import compiled, on_all_cores
from phd_exp.fusion.compiled.linear import NOTHING, add, newton_step, seen_of
from phd_exp.fusion.polish import FARTHEST, KINK, PENALTY, RIDGE, ROUNDS

STILL = 1e-16  # metres; a batch makes all its rounds, one problem may leave off


@on_all_cores
@no_type_check
def polish(slope, at_origin, a, u, lam):
    """Moves each u to its optimum, and lam to its multipliers."""
    for i in prange(len(a)):
        _polish(slope[i], at_origin[i], a[i], u[i], lam[i])


@compiled
@no_type_check
def _polish(slope, at_origin, a, u, lam):
    cameras = len(a)
    start, first = u.copy(), lam.copy()
    kink = np.zeros(cameras, dtype=np.bool_)
    for _ in range(ROUNDS):
        du = newton_step(_linearise(slope, at_origin, a, u, lam, kink))
        for j in range(3):
            u[j] += du[j]
        for c in range(cameras):
            if kink[c]:
                lam[c] += PENALTY * (seen_of(slope[c], at_origin[c], u)[2] - 1)
        if max(abs(du[0]), abs(du[1]), abs(du[2])) <= STILL:
            break
    if not np.all(np.abs(u - start) <= FARTHEST):  # NaN too
        u[:] = start
        lam[:] = first
    for c in range(cameras):
        lam[c] = min(max(lam[c], -1.0), 1.0)


@compiled
@no_type_check
def _linearise(slope, at_origin, a, u, lam, kink):
    """Gradient and Hessian; fills in which cameras are at a kink, and lam of the others."""
    sums = NOTHING
    for c in range(len(a)):
        q_x, q_y, t = seen_of(slope[c], at_origin[c], u)
        near = abs(t - 1) <= KINK
        side = np.sign(lam[c] if near else t - 1)
        kink[c] = near and abs(lam[c]) < 1
        by_t, bend = (1.0, 0.0) if side > 0 else (-1 / (t * t), 2 / (t * t * t))
        if kink[c]:
            by_t, bend = lam[c] + PENALTY * (t - 1), PENALTY
        else:
            lam[c] = side
        weight = 1 / math.sqrt(max(q_x * q_x + q_y * q_y, 1.0))
        unit_x, unit_y = (q_x * weight, q_y * weight) if weight < 1 else (0.0, 0.0)
        xx, xy = weight * (1 + RIDGE - unit_x * unit_x), -weight * unit_x * unit_y
        yy, tt = weight * (1 + RIDGE - unit_y * unit_y), a[c] * (bend + RIDGE)
        sums = add(sums, slope[c], weight * q_x, weight * q_y, a[c] * by_t, xx, xy, yy, tt)
    return sums

"""The exact problem from the smoothed one: the kinks at which the optimum lies become equalities t = 1."""

from typing import no_type_check

import numpy as np

from phd_exp.fusion.arithmetic import ZERO, add, compiled, huber_weight, measured, newton_step

KINK = 1e-6
"""|t - 1| within which a kink may hold the optimum; the smoothed optimum is about 1e-9 from such a kink."""
ROUNDS = 4
PENALTY = 1e7
RIDGE = 1e-12
FARTHEST = 1e-4  # metres; a correction beyond is no polish
STILL = 1e-16  # metres


@compiled
@no_type_check
def polish(slope, at_origin, a, u, lam):
    """Moves u to the optimum, to rounding, and lam to the subgradients of max(t, 1/t) at kinks.

    The method of multipliers: at a kink the energy is a (lam (t - 1) + penalty (t - 1)^2 / 2), and lam moves by the
    penalty times the remaining t - 1. A kink whose lam leaves [-1, 1] does not hold the optimum: its camera goes to
    that side. An optimum farther away than 0.1 mm is none of this problem's: u and lam stay as they were.

    Source: own derivation; checked against a conic solver in tests/fusion/test_conic.py.
    """
    cameras = len(a)
    start, first = u.copy(), lam.copy()
    kink = np.zeros(cameras, dtype=np.bool_)
    for _ in range(ROUNDS):
        du = newton_step(_linearise(slope, at_origin, a, u, lam, kink))
        for j in range(3):
            u[j] += du[j]
        for c in range(cameras):
            if kink[c]:
                lam[c] += PENALTY * (measured(slope[c], at_origin[c], u)[2] - 1)
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
    """Gradient and Hessian; fills `kink` with the cameras at one, and lam of the others with their side."""
    sums = ZERO
    for c in range(len(a)):
        q_x, q_y, t = measured(slope[c], at_origin[c], u)
        near = abs(t - 1) <= KINK
        side = np.sign(lam[c] if near else t - 1)
        kink[c] = near and abs(lam[c]) < 1
        by_t, bend = (1.0, 0.0) if side > 0 else (-1 / (t * t), 2 / (t * t * t))
        if kink[c]:
            by_t, bend = lam[c] + PENALTY * (t - 1), PENALTY
        else:
            lam[c] = side
        weight, unit_x, unit_y = huber_weight(q_x, q_y)
        xx, xy = weight * (1 + RIDGE - unit_x * unit_x), -weight * unit_x * unit_y
        yy, tt = weight * (1 + RIDGE - unit_y * unit_y), a[c] * (bend + RIDGE)
        sums = add(sums, slope[c], weight * q_x, weight * q_y, a[c] * by_t, xx, xy, yy, tt)
    return sums

"""As `phd_exp.fusion.certificate`."""

import math
from typing import no_type_check

import numpy as np
from numba import prange

from phd_exp.fusion.certificate import RADII
from phd_exp.fusion.compiled import TINY, compiled, on_all_cores
from phd_exp.fusion.compiled.linear import NOTHING, add, factor, forward, seen_of, squared
from phd_exp.fusion.polish import KINK


@on_all_cores
@no_type_check
def certify(slope, at_origin, a, u, lam, subgradient, relative, distance):
    """Fills the last three, of each problem one."""
    for i in prange(len(a)):
        subgradient[i], relative[i], distance[i] = _certify(slope[i], at_origin[i], a[i], u[i], lam[i])


@compiled
@no_type_check
def _certify(slope, at_origin, a, u, lam):
    cameras = len(a)
    seen, kink = np.empty((cameras, 3)), np.zeros(cameras, dtype=np.bool_)
    sums = NOTHING
    pull = error = 0.0
    for c in range(cameras):
        q_x, q_y, t = seen[c] = seen_of(slope[c], at_origin[c], u)
        kink[c] = abs(t - 1) <= KINK and abs(lam[c]) < 1
        weight = 1 / math.sqrt(max(q_x * q_x + q_y * q_y, 1.0))
        by_t = lam[c] if kink[c] else 1.0 if t >= 1 else -1 / (t * t)
        sums = add(sums, slope[c], weight * q_x, weight * q_y, a[c] * by_t, 0.0, 0.0, 0.0, 0.0)
        pull += a[c] * math.sqrt(squared(slope[c, 2]))
        error += 3 * a[c] * abs(t - 1) if kink[c] else 0.0
    distance = np.inf
    for radius in RADII:
        bound = _distance(_least_curvature(slope, seen, a, lam, kink, radius), sums, error)
        if bound <= radius:
            distance = bound
            break
    norm = math.sqrt(squared(sums))
    return norm, norm / pull, distance


@compiled
@no_type_check
def _distance(curvature, G, error):
    """The bound from curvature, subgradient and error; NaN where the curvature is not positive definite."""
    L = factor(curvature)
    trace = squared(forward(L, (1.0, 0.0, 0.0))) + squared(forward(L, (0.0, 1.0, 0.0)))
    if curvature[8] != 0:  # three unknowns
        trace += squared(forward(L, (0.0, 0.0, 1.0)))
    drop = squared(forward(L, G))
    return math.sqrt(trace) * (math.sqrt(drop) + math.sqrt(drop + 2 * error))


@compiled
@no_type_check
def _least_curvature(slope, seen, a, lam, kink, radius):
    """The lower bound of the curvature within a radius."""
    sums = NOTHING
    for c in range(len(a)):
        q_x, q_y, t = seen[c]
        delta = radius * math.sqrt(squared(slope[c, 0]) + squared(slope[c, 1]))
        length = math.sqrt(q_x * q_x + q_y * q_y)
        xx, xy, yy = 1.0, 0.0, 1.0
        if length + delta >= 1:
            x, y, turn = q_x / max(length, 0.5), q_y / max(length, 0.5), delta / max(length, 0.5)
            scale = 1 / (length + delta) if turn < 1 else 0.0
            xx, xy, yy = scale * (1 - turn - x * x), -scale * x * y, scale * (1 - turn - y * y)
        reach = radius * math.sqrt(squared(slope[c, 2]))
        far = t + reach
        depth = 2 / (far * far * far) if far < 1 else 0.0
        if kink[c]:
            depth = 2 * (1 - abs(lam[c])) / max(reach, TINY)
        sums = add(sums, slope[c], 0.0, 0.0, 0.0, xx, xy, yy, a[c] * depth)
    return sums

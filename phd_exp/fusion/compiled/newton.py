"""As `phd_exp.fusion.newton`."""

import math
from typing import no_type_check

import numpy as np
from numba import prange

from phd_exp.fusion.compiled import compiled, on_all_cores
from phd_exp.fusion.compiled.energy import extended_inverse, huber
from phd_exp.fusion.compiled.linear import NOTHING, add, moved_of, newton_step, seen_of
from phd_exp.fusion.newton import (
    ARMIJO,
    FIRST_WIDTH,
    MOST_HALVINGS,
    MOST_STEPS,
    RIDGE,
    SETTLED,
    SHRINK,
    WIDTH_FLOOR,
)


@on_all_cores
@no_type_check
def minimise(slope, at_origin, a, u, lam, least):
    """Moves each u to its minimum, and fills lam with the multipliers of the kinks."""
    for i in prange(len(a)):
        _minimise(slope[i], at_origin[i], a[i], u[i], lam[i], least)


@compiled
@no_type_check
def _minimise(slope, at_origin, a, u, lam, least):
    cameras = len(a)
    seen, moved = np.empty((cameras, 3)), np.empty((cameras, 3))
    y, terms = np.zeros((cameras, 2)), np.empty((cameras, 6))
    width = FIRST_WIDTH
    for _ in range(MOST_STEPS):
        before, sums = _linearise(slope, at_origin, a, u, y, lam, width, least, seen, terms)
        du = newton_step(sums)
        for c in range(cameras):
            moved[c] = moved_of(slope[c], du)
        descent = sums[0] * du[0] + sums[1] * du[1] + sums[2] * du[2]
        share = _line_search(before, seen, moved, a, descent, width, least)
        settled = _step(seen, terms, moved, y, lam, share)
        for j in range(3):
            u[j] += share * du[j]
        if width == WIDTH_FLOOR and settled:
            break
        width = max(width * SHRINK, WIDTH_FLOOR)


@compiled
@no_type_check
def _linearise(slope, at_origin, a, u, y, lam, width, least, seen, terms):
    """The smooth energy, its gradient and Hessian; fills in what is seen at u and the terms that `_step` needs."""
    value, sums = 0.0, NOTHING
    for c in range(len(a)):
        q_x, q_y, t = seen[c] = seen_of(slope[c], at_origin[c], u)
        squared = q_x * q_x + q_y * q_y
        weight = 1 / math.sqrt(max(squared, 1.0))
        inverse, first, second = extended_inverse(t, least)
        g, g_slope = (t - inverse) / 2, (1 - first) / 2
        s = math.sqrt(g * g + width * width)
        side = g / s
        value += huber(squared) + a[c] * ((t + inverse) / 2 + s)
        unit_x, unit_y = (q_x * weight, q_y * weight) if weight < 1 else (0.0, 0.0)
        terms[c] = weight, unit_x, unit_y, g, g_slope, s
        xx = weight * (1 - y[c, 0] * unit_x) + RIDGE * weight
        xy = -weight * (y[c, 0] * unit_y + y[c, 1] * unit_x) / 2
        yy = weight * (1 - y[c, 1] * unit_y) + RIDGE * weight
        bend = (1 - side) * second / 2 + g_slope * g_slope * (1 - lam[c] * side) / s
        by_t = a[c] * ((1 + first) / 2 + side * g_slope)
        sums = add(sums, slope[c], weight * q_x, weight * q_y, by_t, xx, xy, yy, a[c] * (bend + RIDGE))
    return value, sums


@compiled
@no_type_check
def _line_search(before, seen, moved, a, descent, width, least):
    """The share of the step to take: halved until the energy falls by Armijo's rule."""
    enough = before + 1e-12 * abs(before)
    share = 1.0
    for _ in range(MOST_HALVINGS):
        value = 0.0
        for c in range(len(a)):
            q_x, q_y = seen[c, 0] + share * moved[c, 0], seen[c, 1] + share * moved[c, 1]
            t = seen[c, 2] + share * moved[c, 2]
            inverse = extended_inverse(t, least)[0]
            g = (t - inverse) / 2
            value += huber(q_x * q_x + q_y * q_y)
            value += a[c] * ((t + inverse) / 2 + math.sqrt(g * g + width * width))
        if not value > enough + ARMIJO * share * descent:
            break
        share /= 2
    return share


@compiled
@no_type_check
def _step(seen, terms, moved, y, lam, share):
    """The duals after a step; whether what is seen hardly moved."""
    settled = True
    for c in range(len(lam)):
        weight, unit_x, unit_y, g, g_slope, s = terms[c]
        lam[c] += (g - lam[c] * s + (1 - lam[c] * g / s) * g_slope * moved[c, 2]) / s
        lam[c] = min(max(lam[c], -1.0), 1.0)
        along = unit_x * moved[c, 0] + unit_y * moved[c, 1]
        y_x = weight * (seen[c, 0] + moved[c, 0] - y[c, 0] * along)
        y_y = weight * (seen[c, 1] + moved[c, 1] - y[c, 1] * along)
        length = math.sqrt(max(y_x * y_x + y_y * y_y, 1.0))
        y[c, 0], y[c, 1] = y_x / length, y_y / length
        for m in range(3):
            settled &= abs(share * moved[c, m]) <= SETTLED * (1 + abs(seen[c, m]))
    return settled

"""The smoothed problem by a primal-dual Newton method.

The energy of a camera is h(|q|) + a max(t, 1/t). With g = (t - 1/t)/2 the maximum is (t + 1/t)/2 + |g|, and |g| is
smoothed to s = sqrt(g^2 + width^2). This is the w of the epigraph's barrier, (w - t)(w - 1/t) = width^2. It is convex
in t, because its second derivative is (1 - g/s)/t^3 + width^2 g'^2/s^3, and at most `width` too large.

Plain Newton steps see no curvature where h or max(t, 1/t) is linear and overshoot. So, as in total-variation
denoising (Chan, Golub and Mulet, 1999), the directions of both are unknowns too:

    y max(1, |q|) = q,    lam s = g    with |y| <= 1, |lam| <= 1,

each linearised together with the stationarity in u. From y = 0, lam = 0 the first steps are those of reweighted least
squares, the last ones quadratic. The width falls to its floor meanwhile; a line search keeps every step a descent.

Source: own derivation; optima checked against a conic solver in tests/fusion/test_conic.py.
"""

import math
from typing import no_type_check

import numpy as np

from phd_exp.fusion.arithmetic import ZERO, add, change, compiled, huber, huber_weight, measured, newton_step

WIDTH_FLOOR = 1e-9
FIRST_WIDTH, SHRINK = 1.0, 0.01
MOST_STEPS, MOST_HALVINGS = 80, 40
SETTLED = 1e-9  # relative change of (q_x, q_y, t)
RIDGE = 1e-9  # share of the curvature of least squares: a flat direction must not stop the rest
ARMIJO = 1e-4
LEAST_DEPTHS = (1e-2, 1e-4, 1e-6)
"""Shares of the predicted depth below which 1/t is continued, tried in turn until the optimum lies beyond."""


@compiled
@no_type_check
def optimum(slope, at_origin, a, u, lam):
    """Moves u to the optimum and lam to its multipliers; returns whether one has t >= 1e-6 in every camera.

    If not, every position in front of all cameras is worse than what 1/t = 1e6 costs in one of them.
    """
    for least in LEAST_DEPTHS:
        lam[:] = 0.0
        minimise(slope, at_origin, a, u, lam, least)
        nearest = np.inf
        for c in range(len(a)):
            nearest = min(nearest, measured(slope[c], at_origin[c], u)[2])
        if nearest >= least:
            return True
    return False


@compiled
@no_type_check
def minimise(slope, at_origin, a, u, lam, least):
    """Moves u to the minimum with 1/t continued below t = least, and lam to the multipliers of the kinks.

    After 80 steps u is left where it is: the certificate judges it.
    """
    cameras = len(a)
    at, moved = np.empty((cameras, 3)), np.empty((cameras, 3))
    y, terms = np.zeros((cameras, 2)), np.empty((cameras, 6))
    width = FIRST_WIDTH
    for _ in range(MOST_STEPS):
        before, sums = _linearise(slope, at_origin, a, u, y, lam, width, least, at, terms)
        du = newton_step(sums)
        for c in range(cameras):
            moved[c] = change(slope[c], du)
        descent = sums[0] * du[0] + sums[1] * du[1] + sums[2] * du[2]
        share = _line_search(before, at, moved, a, descent, width, least)
        settled = _step(at, terms, moved, y, lam, share)
        for j in range(3):
            u[j] += share * du[j]
        if width == WIDTH_FLOOR and settled:
            break
        width = max(width * SHRINK, WIDTH_FLOOR)


@compiled
@no_type_check
def extended_inverse(t, least):
    """1/t with its first two derivatives, continued below t = least > 0 by its second-order Taylor polynomial.

    The continuation is convex and finite everywhere, so that a search may start behind a camera. A minimum of the
    continued problem that has t >= least in every camera is the minimum of the problem itself, by convexity.
    """
    inverse = 1 / max(t, least)
    short = min(t - least, 0.0) / least
    return inverse * (1 - short + short * short), inverse * inverse * (2 * short - 1), 2 * inverse**3


@compiled
@no_type_check
def smooth_depth_energy(t, inverse, width):
    """(t + 1/t)/2 + s, which is max(t, 1/t) at width 0; and g and s."""
    g = (t - inverse) / 2
    s = math.sqrt(g * g + width * width)
    return (t + inverse) / 2 + s, g, s


@compiled
@no_type_check
def _linearise(slope, at_origin, a, u, y, lam, width, least, at, terms):
    """The smoothed energy, its gradient and Hessian; fills `at` with (q_x, q_y, t) and `terms` for `_step`."""
    value, sums = 0.0, ZERO
    for c in range(len(a)):
        q_x, q_y, t = at[c] = measured(slope[c], at_origin[c], u)
        inverse, first, second = extended_inverse(t, least)
        depth, g, s = smooth_depth_energy(t, inverse, width)
        value += huber(q_x * q_x + q_y * q_y) + a[c] * depth
        weight, unit_x, unit_y = huber_weight(q_x, q_y)
        g_slope, side = (1 - first) / 2, g / s
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
def _line_search(before, at, moved, a, descent, width, least):
    """The share of the step to take: halved until the energy falls by Armijo's rule."""
    enough = before + 1e-12 * abs(before)  # rounding may add this much where nothing is left to gain
    share = 1.0
    for _ in range(MOST_HALVINGS):
        value = 0.0
        for c in range(len(a)):
            q_x, q_y = at[c, 0] + share * moved[c, 0], at[c, 1] + share * moved[c, 1]
            t = at[c, 2] + share * moved[c, 2]
            depth, _, _ = smooth_depth_energy(t, extended_inverse(t, least)[0], width)
            value += huber(q_x * q_x + q_y * q_y) + a[c] * depth
        if not value > enough + ARMIJO * share * descent:
            break
        share /= 2
    return share


@compiled
@no_type_check
def _step(at, terms, moved, y, lam, share):
    """Moves the duals; returns whether (q_x, q_y, t) hardly moved in any camera."""
    settled = True
    for c in range(len(lam)):
        weight, unit_x, unit_y, g, g_slope, s = terms[c]
        lam[c] += (g - lam[c] * s + (1 - lam[c] * g / s) * g_slope * moved[c, 2]) / s
        lam[c] = min(max(lam[c], -1.0), 1.0)
        along = unit_x * moved[c, 0] + unit_y * moved[c, 1]
        y_x = weight * (at[c, 0] + moved[c, 0] - y[c, 0] * along)
        y_y = weight * (at[c, 1] + moved[c, 1] - y[c, 1] * along)
        length = math.sqrt(max(y_x * y_x + y_y * y_y, 1.0))
        y[c, 0], y[c, 1] = y_x / length, y_y / length
        for m in range(3):
            settled &= abs(share * moved[c, m]) <= SETTLED * (1 + abs(at[c, m]))
    return settled

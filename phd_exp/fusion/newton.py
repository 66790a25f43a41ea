"""The optimum of one problem: of the smoothed problem by a primal-dual Newton method, then of the exact problem.

The energy of a camera is h(|q|) + a max(t, 1/t). With g = (t - 1/t)/2 the maximum is (t + 1/t)/2 + |g|, and |g| is
smoothed to s = sqrt(g^2 + width^2). This is the w of the epigraph's barrier, (w - t)(w - 1/t) = width^2. It is convex
in t, because its second derivative is (1 - g/s)/t^3 + width^2 g'^2/s^3, and at most `width` too large. A camera with
a rounded law of depth has no kink: its energy has a width of its own, and the search never uses a smaller one for it.

Plain Newton steps overshoot where h or max(t, 1/t) is linear, because their curvature is zero there. As in
total-variation denoising (Chan, Golub and Mulet, 1999), the directions of both are therefore unknowns too:

    y max(1, |q|) = q,    lam s = g    with |y| <= 1, |lam| <= 1,

each linearised together with the stationarity in u. From y = 0, lam = 0 the first steps are those of reweighted least
squares, and the last ones converge quadratically, while the width falls to its floor. A line search ensures that the
energy falls in every step. `polish` then replaces the kinks at which the optimum lies by equalities t = 1.

Source: own derivation; optima checked against a conic solver in tests/fusion/test_conic.py.
"""
# mypy: no-check-untyped-defs, allow-untyped-defs

import math

import numpy as np

from phd_exp.fusion.arithmetic import (
    ZERO,
    add,
    change,
    compiled,
    huber,
    huber_weight,
    measured,
    newton_step,
    rounded_slopes,
    squared_norm,
)

WIDTH_FLOOR = 1e-9
FIRST_WIDTH, SHRINK = 1.0, 0.01
MOST_STEPS, MOST_HALVINGS = 80, 40
SETTLED = 1e-9  # relative change of (q_x, q_y, t)
RIDGE = 1e-9  # share of the curvature of least squares: a flat direction must not stop the rest
ARMIJO = 1e-4
KINK = 1e-6  # |t - 1| within which a kink may hold the optimum; the smoothed optimum is about 1e-9 from such a kink
ROUNDS, PENALTY = 4, 1e7
EXACT_RIDGE = 1e-12
FARTHEST = 1e-4  # metres; a larger correction is rejected
STILL = 1e-16  # metres
LEAST_DEPTHS = (1e-2, 1e-4, 1e-6)
"""Shares of the predicted depth below which 1/t is continued, tried in turn until the optimum lies beyond."""


@compiled
def optimum(slope, at_origin, a, own, u, lam):
    """Moves u to the optimum and lam to its multipliers; returns whether one has t >= 1e-6 in every camera.

    If not, every position in front of all cameras is worse than what 1/t = 1e6 costs in one of them. `own` is the
    width of each camera's rounded mode.
    """
    for least in LEAST_DEPTHS:
        lam[:] = 0.0
        minimise(slope, at_origin, a, own, u, lam, least)
        nearest = np.inf
        for c in range(len(a)):
            nearest = min(nearest, measured(slope[c], at_origin[c], u)[2])
        if nearest >= least:
            return True
    return False


@compiled
def minimise(slope, at_origin, a, own, u, lam, least):
    """Moves u to the minimum with 1/t continued below t = least, and lam to the multipliers of the kinks.

    It stops after 80 steps at the latest; `subgradient` decides whether that was enough.
    """
    cameras = len(a)
    at, moved = np.empty((cameras, 3)), np.empty((cameras, 3))
    y, terms = np.zeros((cameras, 2)), np.empty((cameras, 6))
    width = FIRST_WIDTH
    for _ in range(MOST_STEPS):
        before, sums = _linearise_smooth(slope, at_origin, a, own, u, y, lam, width, least, at, terms)
        du = newton_step(sums)
        for c in range(cameras):
            moved[c] = change(slope[c], du)
        descent = sums[0] * du[0] + sums[1] * du[1] + sums[2] * du[2]
        share = _line_search(before, at, moved, a, own, descent, width, least)
        settled = _step(at, terms, moved, y, lam, share)
        for j in range(3):
            u[j] += share * du[j]
        if width == WIDTH_FLOOR and settled:
            break
        width = max(width * SHRINK, WIDTH_FLOOR)


@compiled
def extended_inverse(t, least):
    """1/t with its first two derivatives, continued below t = least > 0 by its second-order Taylor polynomial.

    The continuation is convex and finite everywhere, so that a search may start behind a camera. By convexity a
    minimum of the continued problem with t >= least in every camera is the minimum of the original problem.
    """
    inverse = 1 / max(t, least)
    short = min(t - least, 0.0) / least
    return inverse * (1 - short + short * short), inverse * inverse * (2 * short - 1), 2 * inverse**3


@compiled
def smooth_depth_energy(t, inverse, width):
    """(t + 1/t)/2 + s, which is max(t, 1/t) at width 0; and g and s."""
    g = (t - inverse) / 2
    s = math.sqrt(g * g + width * width)
    return (t + inverse) / 2 + s, g, s


@compiled
def _linearise_smooth(slope, at_origin, a, own, u, y, lam, width, least, at, terms):
    """The smoothed energy, its gradient and Hessian; fills `at` with (q_x, q_y, t) and `terms` for `_step`."""
    value, sums = 0.0, ZERO
    for c in range(len(a)):
        q_x, q_y, t = at[c] = measured(slope[c], at_origin[c], u)
        inverse, first, second = extended_inverse(t, least)
        depth, g, s = smooth_depth_energy(t, inverse, max(width, own[c]))
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
def _line_search(before, at, moved, a, own, descent, width, least):
    """The share of the step to take: halved until the energy falls by Armijo's rule."""
    enough = before + 1e-12 * abs(before)  # rounding may add this much where nothing is left to gain
    share = 1.0
    for _ in range(MOST_HALVINGS):
        value = 0.0
        for c in range(len(a)):
            q_x, q_y = at[c, 0] + share * moved[c, 0], at[c, 1] + share * moved[c, 1]
            t = at[c, 2] + share * moved[c, 2]
            depth, _, _ = smooth_depth_energy(t, extended_inverse(t, least)[0], max(width, own[c]))
            value += huber(q_x * q_x + q_y * q_y) + a[c] * depth
        if not value > enough + ARMIJO * share * descent:
            break
        share /= 2
    return share


@compiled
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


@compiled
def polish(slope, at_origin, a, own, u, lam):
    """Moves u to the optimum, to rounding, and lam to the subgradients of max(t, 1/t) at kinks.

    The method of multipliers: at a kink the energy is a (lam (t - 1) + penalty (t - 1)^2 / 2), and lam moves by the
    penalty times the remaining t - 1. A kink whose lam leaves [-1, 1] does not hold the optimum: its camera goes to
    that side. A result farther away than 0.1 mm is rejected: u and lam stay as they were.

    Source: own derivation; checked against a conic solver in tests/fusion/test_conic.py.
    """
    cameras = len(a)
    start, first = u.copy(), lam.copy()
    kink = np.zeros(cameras, dtype=np.bool_)
    for _ in range(ROUNDS):
        du = newton_step(_linearise_exact(slope, at_origin, a, own, u, lam, kink))
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
def exact_slopes(t, own, lam):
    """Whether the optimum may be at the kink, lam, and the derivatives of the energy over a: of the exact one, or of
    the method of multipliers at a kink.
    """
    if own > 0:
        return (False, lam, *rounded_slopes(t, own))
    near = abs(t - 1) <= KINK
    if near and abs(lam) < 1:
        return True, lam, lam + PENALTY * (t - 1), PENALTY
    side = np.sign(lam if near else t - 1)
    by_t, bend = (1.0, 0.0) if side > 0 else (-1 / (t * t), 2 / (t * t * t))
    return False, side, by_t, bend


@compiled
def _linearise_exact(slope, at_origin, a, own, u, lam, kink):
    """Gradient and Hessian; fills `kink` with the cameras at one, and lam of the others with their side."""
    sums = ZERO
    for c in range(len(a)):
        q_x, q_y, t = measured(slope[c], at_origin[c], u)
        kink[c], lam[c], by_t, bend = exact_slopes(t, own[c], lam[c])
        weight, unit_x, unit_y = huber_weight(q_x, q_y)
        xx, xy = weight * (1 + EXACT_RIDGE - unit_x * unit_x), -weight * unit_x * unit_y
        yy, tt = weight * (1 + EXACT_RIDGE - unit_y * unit_y), a[c] * (bend + EXACT_RIDGE)
        sums = add(sums, slope[c], weight * q_x, weight * q_y, a[c] * by_t, xx, xy, yy, tt)
    return sums


@compiled
def subgradient(slope, at_origin, a, own, u, lam):
    """The norm of a subgradient at u, nats per metre, 0 at the optimum alone; and its ratio to sum a |dt/du|."""
    sums, pull = ZERO, 0.0
    for c in range(len(a)):
        q_x, q_y, t = measured(slope[c], at_origin[c], u)
        weight, _, _ = huber_weight(q_x, q_y)
        if own[c] > 0:
            by_t = rounded_slopes(t, own[c])[0]
        elif abs(t - 1) <= KINK and abs(lam[c]) < 1:
            by_t = lam[c]
        else:
            by_t = 1.0 if t >= 1 else -1 / (t * t)
        sums = add(sums, slope[c], weight * q_x, weight * q_y, a[c] * by_t, 0.0, 0.0, 0.0, 0.0)
        pull += a[c] * math.sqrt(squared_norm(slope[c, 2]))
    norm = math.sqrt(squared_norm(sums))
    return norm, norm / pull

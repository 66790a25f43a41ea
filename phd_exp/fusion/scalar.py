"""The methods of `newton` and `polish`, compiled, one problem after the other on each core: what a CPU is best at.

Operations on whole batches spend a CPU's time on launching themselves and on moving what lies between them; a problem
of a few cameras fits into its registers. With a GPU it is the other way round: there `newton` and `polish` serve.
Steps, constants and stopping rules are theirs; tests/fusion/test_scalar.py holds the two against each other. What is
compiled takes its types from what it is given, and checks of annotations would keep it from being compiled.
"""

import math
from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit, prange

from phd_exp.fusion import newton
from phd_exp.fusion import polish as polishing

FIRST_WIDTH, SHRINK, WIDTH_FLOOR = newton.FIRST_WIDTH, newton.SHRINK, newton.WIDTH_FLOOR
MOST_STEPS, MOST_HALVINGS = newton.MOST_STEPS, newton.MOST_HALVINGS
SETTLED, RIDGE, ARMIJO = newton.SETTLED, newton.RIDGE, newton.ARMIJO
ROUNDS, PENALTY, FARTHEST = polishing.ROUNDS, polishing.PENALTY, polishing.FARTHEST
KINK, POLISH_RIDGE = polishing.KINK, polishing.RIDGE

Slope = Float[np.ndarray, "problems cameras 3 k"]
AtOrigin = Float[np.ndarray, "problems cameras 3"]
OfCameras = Float[np.ndarray, "problems cameras"]
Unknowns = Float[np.ndarray, "problems k"]


def minimise(slope: Slope, at_origin: AtOrigin, a: OfCameras, u: Unknowns, least: float) -> OfCameras:
    """As `newton.minimise`: moves each u to its minimum, in place, and returns the multipliers of the kinks."""
    lam = np.zeros_like(a)
    _minimise_all(slope, at_origin, a, u, lam, least)
    return lam


def polish(slope: Slope, at_origin: AtOrigin, a: OfCameras, u: Unknowns, lam: OfCameras) -> None:
    """As `polish.polish`: moves each u to its optimum, and lam to its multipliers, in place."""
    _polish_all(slope, at_origin, a, u, lam)


@njit(parallel=True, cache=True, error_model="numpy")
@no_type_check
def _minimise_all(slope, at_origin, a, u, lam, least):
    for i in prange(len(a)):
        _minimise(slope[i], at_origin[i], a[i], u[i], lam[i], least)


@njit(parallel=True, cache=True, error_model="numpy")
@no_type_check
def _polish_all(slope, at_origin, a, u, lam):
    for i in prange(len(a)):
        _polish(slope[i], at_origin[i], a[i], u[i], lam[i])


@njit(cache=True, error_model="numpy")
@no_type_check
def _minimise(slope, at_origin, a, u, lam, least):
    cameras, _, k = slope.shape
    seen, moved = np.empty((cameras, 3)), np.empty((cameras, 3))
    y, du, gradient, H = np.zeros((cameras, 2)), np.empty(k), np.empty(k), np.empty((k, k))
    width = FIRST_WIDTH
    for _ in range(MOST_STEPS):
        before = _linearise(slope, at_origin, a, u, y, lam, width, least, seen, gradient, H)
        _solve(H, gradient, du)
        descent = 0.0
        for j in range(k):
            descent += gradient[j] * du[j]
        for c in range(cameras):
            for m in range(3):
                moved[c, m] = 0.0
                for j in range(k):
                    moved[c, m] += slope[c, m, j] * du[j]
        share = _line_search(before, seen, moved, a, descent, width, least)
        settled = _step(seen, moved, y, lam, share, width, least)
        for j in range(k):
            u[j] += share * du[j]
        if width == WIDTH_FLOOR and settled:
            break
        width = max(width * SHRINK, WIDTH_FLOOR)


@njit(cache=True, error_model="numpy")
@no_type_check
def _linearise(slope, at_origin, a, u, y, lam, width, least, seen, gradient, H):
    """Gradient and Hessian at u, what is seen there, and the smooth energy."""
    cameras, _, k = slope.shape
    gradient[:] = 0.0
    H[:] = 0.0
    value = 0.0
    for c in range(cameras):
        for m in range(3):
            seen[c, m] = at_origin[c, m]
            for j in range(k):
                seen[c, m] += slope[c, m, j] * u[j]
        q_x, q_y, t = seen[c]
        squared = q_x * q_x + q_y * q_y
        weight = 1 / math.sqrt(max(squared, 1.0))
        inverse, first, second = _extended_inverse(t, least)
        g, g_slope = (t - inverse) / 2, (1 - first) / 2
        s = math.sqrt(g * g + width * width)
        side = g / s
        value += _huber(squared) + a[c] * ((t + inverse) / 2 + s)
        unit_x, unit_y = (q_x * weight, q_y * weight) if weight < 1 else (0.0, 0.0)
        xx = weight * (1 - y[c, 0] * unit_x) + RIDGE * weight
        xy = -weight * (y[c, 0] * unit_y + y[c, 1] * unit_x) / 2
        yy = weight * (1 - y[c, 1] * unit_y) + RIDGE * weight
        bend = (1 - side) * second / 2 + g_slope * g_slope * (1 - lam[c] * side) / s
        by_t = a[c] * ((1 + first) / 2 + side * g_slope)
        _add(slope[c], weight * q_x, weight * q_y, by_t, xx, xy, yy, a[c] * (bend + RIDGE), gradient, H)
    return value


@njit(cache=True, error_model="numpy")
@no_type_check
def _add(slope, by_x, by_y, by_t, xx, xy, yy, tt, gradient, H):
    """What one camera adds to gradient and Hessian."""
    x, y, t = slope
    for i in range(len(gradient)):
        gradient[i] += x[i] * by_x + y[i] * by_y + t[i] * by_t
        w_x, w_y, w_t = xx * x[i] + xy * y[i], xy * x[i] + yy * y[i], tt * t[i]
        for j in range(i + 1):
            H[i, j] += w_x * x[j] + w_y * y[j] + w_t * t[j]


@njit(cache=True, error_model="numpy")
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
            inverse = _extended_inverse(t, least)[0]
            g = (t - inverse) / 2
            value += _huber(q_x * q_x + q_y * q_y)
            value += a[c] * ((t + inverse) / 2 + math.sqrt(g * g + width * width))
        if not value > enough + ARMIJO * share * descent:
            break
        share /= 2
    return share


@njit(cache=True, error_model="numpy")
@no_type_check
def _step(seen, moved, y, lam, share, width, least):
    """The duals after a step; whether what is seen hardly moved."""
    settled = True
    for c in range(len(lam)):
        q_x, q_y, t = seen[c]
        weight = 1 / math.sqrt(max(q_x * q_x + q_y * q_y, 1.0))
        unit_x, unit_y = (q_x * weight, q_y * weight) if weight < 1 else (0.0, 0.0)
        inverse, first, _ = _extended_inverse(t, least)
        g, g_slope = (t - inverse) / 2, (1 - first) / 2
        s = math.sqrt(g * g + width * width)
        lam[c] += (g - lam[c] * s + (1 - lam[c] * g / s) * g_slope * moved[c, 2]) / s
        lam[c] = min(max(lam[c], -1.0), 1.0)
        along = unit_x * moved[c, 0] + unit_y * moved[c, 1]
        y_x = weight * (q_x + moved[c, 0] - y[c, 0] * along)
        y_y = weight * (q_y + moved[c, 1] - y[c, 1] * along)
        length = math.sqrt(max(y_x * y_x + y_y * y_y, 1.0))
        y[c, 0], y[c, 1] = y_x / length, y_y / length
        for m in range(3):
            settled &= abs(share * moved[c, m]) <= SETTLED * (1 + abs(seen[c, m]))
    return settled


@njit(cache=True, error_model="numpy")
@no_type_check
def _polish(slope, at_origin, a, u, lam):
    cameras, _, k = slope.shape
    start, first = u.copy(), lam.copy()
    gradient, du, H = np.empty(k), np.empty(k), np.empty((k, k))
    kink = np.zeros(cameras, dtype=np.bool_)
    for _ in range(ROUNDS):
        _linearise_kinks(slope, at_origin, a, u, lam, kink, gradient, H)
        _solve(H, gradient, du)
        u += du
        for c in range(cameras):
            if kink[c]:
                lam[c] += PENALTY * (_seen(slope[c], at_origin[c], u)[2] - 1)
    if not np.all(np.abs(u - start) <= FARTHEST):  # NaN too
        u[:] = start
        lam[:] = first
    for c in range(cameras):
        lam[c] = min(max(lam[c], -1.0), 1.0)


@njit(cache=True, error_model="numpy")
@no_type_check
def _linearise_kinks(slope, at_origin, a, u, lam, kink, gradient, H):
    """Gradient and Hessian of what `polish.polish` describes; which cameras are at a kink, and lam of the others."""
    gradient[:] = 0.0
    H[:] = 0.0
    for c in range(len(a)):
        q_x, q_y, t = _seen(slope[c], at_origin[c], u)
        near = abs(t - 1) <= KINK
        side = np.sign(lam[c] if near else t - 1)
        kink[c] = near and abs(lam[c]) < 1
        by_t, bend = (1.0, 0.0) if side > 0 else (-1 / (t * t), 2 / t**3)
        if kink[c]:
            by_t, bend = lam[c] + PENALTY * (t - 1), PENALTY
        else:
            lam[c] = side
        weight = 1 / math.sqrt(max(q_x * q_x + q_y * q_y, 1.0))
        unit_x, unit_y = (q_x * weight, q_y * weight) if weight < 1 else (0.0, 0.0)
        xx, xy = weight * (1 + POLISH_RIDGE - unit_x * unit_x), -weight * unit_x * unit_y
        yy, tt = weight * (1 + POLISH_RIDGE - unit_y * unit_y), a[c] * (bend + POLISH_RIDGE)
        _add(slope[c], weight * q_x, weight * q_y, a[c] * by_t, xx, xy, yy, tt, gradient, H)


@njit(cache=True, error_model="numpy")
@no_type_check
def _seen(slope, at_origin, u):
    q_x, q_y, t = at_origin
    for j in range(len(u)):
        q_x += slope[0, j] * u[j]
        q_y += slope[1, j] * u[j]
        t += slope[2, j] * u[j]
    return q_x, q_y, t


@njit(cache=True, error_model="numpy")
@no_type_check
def _solve(H, gradient, du):
    """du with H du = -gradient by Cholesky's factors, which take H's place; NaN where it is not positive definite."""
    k = len(du)
    for i in range(k):
        for j in range(i + 1):
            rest = H[i, j]
            for m in range(j):
                rest -= H[i, m] * H[j, m]
            H[i, j] = rest / H[j, j] if j < i else math.sqrt(rest)
    for i in range(k):
        rest = -gradient[i]
        for m in range(i):
            rest -= H[i, m] * du[m]
        du[i] = rest / H[i, i]
    for i in range(k - 1, -1, -1):
        for m in range(i + 1, k):
            du[i] -= H[m, i] * du[m]
        du[i] /= H[i, i]


@njit(cache=True, error_model="numpy")
@no_type_check
def _huber(squared):
    return math.sqrt(squared) - 0.5 if squared > 1 else squared / 2


@njit(cache=True, error_model="numpy")
@no_type_check
def _extended_inverse(t, least):
    """As `energy.extended_inverse`."""
    inverse = 1 / max(t, least)
    short = min(t - least, 0.0) / least
    return inverse * (1 - short + short * short), inverse * inverse * (2 * short - 1), 2 * inverse**3

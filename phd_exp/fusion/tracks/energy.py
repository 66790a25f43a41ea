"""The energy of a path: that of the frames' predictions, and a quadratic one of the motion from frame to frame.

A frame has d unknowns x_k, of which the first three, the position, are measured. Each camera measures (q_x, q_y, t) =
at_origin + slope x_k, as in `phd_exp.fusion.arithmetic`. Its energy is p h(|q|) + a m(t) with the m there, or
(q_x^2 + q_y^2 + t^2)/2 of a Gaussian prediction, which has a = GAUSSIAN. A camera that takes no part has slope 0,
q = 0, t = 1 and a = p = 0.

The motion is `start`, the mean and precision of x_0, and `steps`, the transitions F_k and the precisions W_k of
x_(k+1) - F_k x_k. Its energy is half the sum of (x_0 - mean).precision (x_0 - mean) and of all r.W_k r.
"""
# mypy: no-check-untyped-defs, allow-untyped-defs

import math
from typing import NamedTuple

import numpy as np

from phd_exp.fusion.arithmetic import compiled, huber, huber_weight
from phd_exp.fusion.newton import RIDGE, extended_inverse, smooth_depth_energy
from phd_exp.fusion.views import GAUSSIAN


class Chain(NamedTuple):
    """The energy of a path of N frames, C cameras and d unknowns a frame.

    Attributes:
        slope: d(q_x, q_y, t)/dv, N x C x 3 x 3.
        at_origin: (q_x, q_y, t) at x = 0, N x C x 3.
        a: weighted precision of the depth, or GAUSSIAN, N x C.
        p: weight of the projection, N x C.
        sharpness: precision of the depth without its weight, N x C.
        own: the width of a rounded mode of t, N x C.
        mean: expected unknowns of the first frame, d.
        precision: inverse of their covariance, d x d; 0 in a direction that is not known before.
        F: the motion from one frame to the next, N-1 x d x d.
        W: inverse covariance of its noise, N-1 x d x d.
    """

    slope: np.ndarray
    at_origin: np.ndarray
    a: np.ndarray
    p: np.ndarray
    sharpness: np.ndarray
    own: np.ndarray
    mean: np.ndarray
    precision: np.ndarray
    F: np.ndarray
    W: np.ndarray


@compiled
def measure(slope, x, at):
    """Adds slope x to `at`, for all cameras of all frames."""
    frames, cameras = slope.shape[:2]
    for k in range(frames):
        for c in range(cameras):
            for i in range(3):
                value = at[k, c, i]
                for j in range(3):
                    value += slope[k, c, i, j] * x[k, j]
                at[k, c, i] = value


@compiled
def motion_energy(chain, whole, x, gradient):
    """The energy of the motion; its quadratic part alone if `whole` is 0 instead of 1. Fills in the gradient."""
    gradient[:] = 0.0
    residual = x[0] - whole * chain.mean
    value = _quadratic(chain.precision, residual, gradient[0])
    for k in range(len(x) - 1):
        value += _step_energy(chain.F[k], chain.W[k], x[k], x[k + 1], residual, gradient[k], gradient[k + 1])
    return value


@compiled
def _quadratic(precision, residual, gradient):
    """r.W r/2; adds W r to the gradient."""
    value = 0.0
    for i in range(len(residual)):
        pull = 0.0
        for j in range(len(residual)):
            pull += precision[i, j] * residual[j]
        value += pull * residual[i] / 2
        gradient[i] += pull
    return value


@compiled
def _step_energy(F, W, before, after, residual, by_before, by_after):
    """The energy of one step between frames; fills `residual`, and adds to the gradients of both frames."""
    d = len(residual)
    for i in range(d):
        residual[i] = after[i]
        for j in range(d):
            residual[i] -= F[i, j] * before[j]
    value = 0.0
    for i in range(d):
        pull = 0.0
        for j in range(d):
            pull += W[i, j] * residual[j]
        value += pull * residual[i] / 2
        by_after[i] += pull
        for j in range(d):
            by_before[j] -= F[i, j] * pull
    return value


@compiled
def motion_curvature(chain, diagonal, coupling):
    """Fills in the block tridiagonal second derivative of the energy of the motion."""
    F, W = chain.F, chain.W
    frames, d = diagonal.shape[0], diagonal.shape[1]
    diagonal[:] = 0.0
    diagonal[0] = chain.precision
    for k in range(frames - 1):
        for i in range(d):
            for j in range(d):
                diagonal[k + 1, i, j] += W[k, i, j]
                value = 0.0
                for m in range(d):
                    value -= W[k, i, m] * F[k, m, j]
                coupling[k, i, j] = value
        for i in range(d):
            for j in range(d):
                for m in range(d):
                    diagonal[k, i, j] -= F[k, m, i] * coupling[k, m, j]


@compiled
def add_camera(slope, by_x, by_y, by_t, xx, xy, yy, tt, gradient, curvature):
    """Adds a camera's gradient and lower triangle of the curvature, which are given with respect to (q_x, q_y, t)."""
    for i in range(3):
        x, y, t = slope[0, i], slope[1, i], slope[2, i]
        gradient[i] += x * by_x + y * by_y + t * by_t
        along_x, along_y, along_t = xx * x + xy * y, xy * x + yy * y, tt * t
        for j in range(i + 1):
            curvature[i, j] += along_x * slope[0, j] + along_y * slope[1, j] + along_t * slope[2, j]


@compiled
def camera_energy(q_x, q_y, t, a, p, own, width, least):
    """The energy of one camera, smoothed as in `phd_exp.fusion.newton`; exact for the width 0."""
    if a == GAUSSIAN:
        return (q_x * q_x + q_y * q_y + t * t) / 2
    depth, _, _ = smooth_depth_energy(t, extended_inverse(t, least)[0], max(own, width))
    return p * huber(q_x * q_x + q_y * q_y) + a * depth


@compiled
def frames_energy(chain, at, moved, share, width, least):
    """The energy of all cameras at `at` + share `moved`."""
    frames, cameras = chain.a.shape
    value = 0.0
    for k in range(frames):
        for c in range(cameras):
            q_x, q_y = at[k, c, 0] + share * moved[k, c, 0], at[k, c, 1] + share * moved[k, c, 1]
            t = at[k, c, 2] + share * moved[k, c, 2]
            value += camera_energy(q_x, q_y, t, chain.a[k, c], chain.p[k, c], chain.own[k, c], width, least)
    return value


@compiled
def add_smoothed(slope, at, a, p, own, y, lam, width, least, terms, gradient, curvature):
    """Adds one camera's smoothed gradient and its curvature given the duals; fills `terms`; see `fusion.newton`."""
    q_x, q_y, t = at
    if a == GAUSSIAN:
        add_camera(slope, q_x, q_y, t, 1.0, 0.0, 1.0, 1.0, gradient, curvature)
        return
    inverse, first, second = extended_inverse(t, least)
    _, g, s = smooth_depth_energy(t, inverse, max(own, width))
    weight, unit_x, unit_y = huber_weight(q_x, q_y)
    g_slope, side = (1 - first) / 2, g / s
    terms[:] = weight, unit_x, unit_y, g, g_slope, s
    weight *= p
    xx = weight * (1 - y[0] * unit_x) + RIDGE * weight
    xy = -weight * (y[0] * unit_y + y[1] * unit_x) / 2
    yy = weight * (1 - y[1] * unit_y) + RIDGE * weight
    bend = (1 - side) * second / 2 + g_slope * g_slope * (1 - lam * side) / s
    by_t = a * ((1 + first) / 2 + side * g_slope)
    add_camera(slope, weight * q_x, weight * q_y, by_t, xx, xy, yy, a * (bend + RIDGE), gradient, curvature)


@compiled
def move_duals(at, terms, moved, y, lam, a):
    """The new lam of one camera after a step; moves y in place; see `fusion.newton`."""
    if a == GAUSSIAN:
        return lam
    weight, unit_x, unit_y, g, g_slope, s = terms
    lam += (g - lam * s + (1 - lam * g / s) * g_slope * moved[2]) / s
    along = unit_x * moved[0] + unit_y * moved[1]
    y_x = weight * (at[0] + moved[0] - y[0] * along)
    y_y = weight * (at[1] + moved[1] - y[1] * along)
    length = math.sqrt(max(y_x * y_x + y_y * y_y, 1.0))
    y[0], y[1] = y_x / length, y_y / length
    return min(max(lam, -1.0), 1.0)

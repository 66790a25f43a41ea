"""The arithmetic of one problem: what a camera measures of a position, the energy, and systems of three unknowns.

Every camera measures (q_x, q_y, t) of a position (`ProjectedHuber.whiten`, t = z/mu_z), which is affine in
the unknowns u: `at_origin` (3) plus `slope` (3 x 3) times u. Its energy is h(|q|) + a m(t) with the precision a and

    m(t) = (t + 1/t)/2 + sqrt(g^2 + width^2),    g = (t - 1/t)/2,

which is max(t, 1/t) for the width 0, that of the paper's law; others have a rounded mode, see
`phd_exp.distributions.rounded`. On a plane there are two unknowns; the third column of each slope is zero, and so is
H_22 below. A camera that takes no part has slope 0, q = 0, t = 1 and a = 0.

A gradient and a symmetric matrix are one tuple (g_0, g_1, g_2, H_00, H_10, H_11, H_20, H_21, H_22), which stays in
registers. Arguments of compiled functions have no annotations: the types are those of the values. Division by zero
gives infinity.
"""
# mypy: no-check-untyped-defs, allow-untyped-defs

import math

import numpy as np
from numba import njit

compiled = njit(error_model="numpy")
TINY = float(np.finfo(np.float64).tiny)
ZERO = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@compiled
def measured(slope, at_origin, u):
    """(q_x, q_y, t) of one camera at u."""
    x, y, t = change(slope, u)
    return at_origin[0] + x, at_origin[1] + y, at_origin[2] + t


@compiled
def change(slope, du):
    """The change of (q_x, q_y, t) of one camera with a change of u."""
    return (
        slope[0, 0] * du[0] + slope[0, 1] * du[1] + slope[0, 2] * du[2],
        slope[1, 0] * du[0] + slope[1, 1] * du[1] + slope[1, 2] * du[2],
        slope[2, 0] * du[0] + slope[2, 1] * du[1] + slope[2, 2] * du[2],
    )


@compiled
def huber(squared):
    """h(|q|) of |q|^2."""
    return math.sqrt(squared) - 0.5 if squared > 1 else squared / 2


@compiled
def huber_weight(q_x, q_y):
    """h'(|q|)/|q|, and q/|q| where h is linear, else 0."""
    weight = 1 / math.sqrt(max(q_x * q_x + q_y * q_y, 1.0))
    if weight < 1:
        return weight, q_x * weight, q_y * weight
    return weight, 0.0, 0.0


@compiled
def depth_excess(t, width):
    """m(t) - m(1)."""
    if width == 0:
        return max(t, 1 / t) - 1
    g = (t - 1 / t) / 2
    return (t - 1) * (t - 1) / (2 * t) + g * g / (math.sqrt(g * g + width * width) + width)


@compiled
def rounded_slopes(t, width):
    """The first two derivatives of m at t, for a positive width."""
    g, by_t = (t - 1 / t) / 2, (1 + 1 / (t * t)) / 2
    s = math.sqrt(g * g + width * width)
    share = width / s
    first = (1 - 1 / (t * t)) / 2 + g / s * by_t
    return first, (1 - g / s) / (t * t * t) + share * share * by_t * by_t / s


@compiled
def add(sums, slope, by_x, by_y, by_t, xx, xy, yy, tt):
    """Gradient and Hessian plus those of one more camera, which are given with respect to (q_x, q_y, t)."""
    g_0, g_1, g_2, h_00, h_10, h_11, h_20, h_21, h_22 = sums
    x_0, x_1, x_2 = slope[0, 0], slope[0, 1], slope[0, 2]
    y_0, y_1, y_2 = slope[1, 0], slope[1, 1], slope[1, 2]
    t_0, t_1, t_2 = slope[2, 0], slope[2, 1], slope[2, 2]
    a_0, b_0, c_0 = xx * x_0 + xy * y_0, xy * x_0 + yy * y_0, tt * t_0
    a_1, b_1, c_1 = xx * x_1 + xy * y_1, xy * x_1 + yy * y_1, tt * t_1
    a_2, b_2, c_2 = xx * x_2 + xy * y_2, xy * x_2 + yy * y_2, tt * t_2
    return (
        g_0 + x_0 * by_x + y_0 * by_y + t_0 * by_t,
        g_1 + x_1 * by_x + y_1 * by_y + t_1 * by_t,
        g_2 + x_2 * by_x + y_2 * by_y + t_2 * by_t,
        h_00 + a_0 * x_0 + b_0 * y_0 + c_0 * t_0,
        h_10 + a_1 * x_0 + b_1 * y_0 + c_1 * t_0,
        h_11 + a_1 * x_1 + b_1 * y_1 + c_1 * t_1,
        h_20 + a_2 * x_0 + b_2 * y_0 + c_2 * t_0,
        h_21 + a_2 * x_1 + b_2 * y_1 + c_2 * t_1,
        h_22 + a_2 * x_2 + b_2 * y_2 + c_2 * t_2,
    )


@compiled
def factor(sums):
    """(L_00, L_10, L_11, L_20, L_21, L_22) with L L^T = H; NaN where H is not positive definite."""
    _, _, _, h_00, h_10, h_11, h_20, h_21, h_22 = sums
    if h_22 == 0:
        h_22 = 1.0
    l_00 = math.sqrt(h_00)
    l_10, l_20 = h_10 / l_00, h_20 / l_00
    l_11 = math.sqrt(h_11 - l_10 * l_10)
    l_21 = (h_21 - l_20 * l_10) / l_11
    return l_00, l_10, l_11, l_20, l_21, math.sqrt(h_22 - l_20 * l_20 - l_21 * l_21)


@compiled
def forward(L, b):
    """The x with L x = b."""
    l_00, l_10, l_11, l_20, l_21, l_22 = L
    x_0 = b[0] / l_00
    x_1 = (b[1] - l_10 * x_0) / l_11
    return x_0, x_1, (b[2] - l_20 * x_0 - l_21 * x_1) / l_22


@compiled
def backward(L, b):
    """The x with L^T x = b."""
    l_00, l_10, l_11, l_20, l_21, l_22 = L
    x_2 = b[2] / l_22
    x_1 = (b[1] - l_21 * x_2) / l_11
    return (b[0] - l_10 * x_1 - l_20 * x_2) / l_00, x_1, x_2


@compiled
def newton_step(sums):
    """-H^(-1) g."""
    L = factor(sums)
    return backward(L, forward(L, (-sums[0], -sums[1], -sums[2])))


@compiled
def squared_norm(x):
    """|x|^2."""
    return x[0] * x[0] + x[1] * x[1] + x[2] * x[2]

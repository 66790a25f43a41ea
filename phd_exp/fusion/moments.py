"""Mean and covariance of a position whose density is the product of the densities of several cameras.

A second derivative at the optimum misses the kinks of depth, which usually hold the optimum, and the linear tails. So
the Gaussian of second derivatives averaged over itself (`_averaged_precision`) only places the points at which the
density is evaluated, and the moments follow from the values.
"""
# mypy: no-check-untyped-defs, allow-untyped-defs

import math
from functools import cache

import numpy as np
from jaxtyping import Float
from numba import njit
from scipy import stats

from phd_exp.fusion.arithmetic import (
    TINY,
    ZERO,
    add,
    backward,
    change,
    compiled,
    factor,
    forward,
    measured,
    squared_norm,
)

PILOT, POINTS = 256, 2048  # of the two passes that find the proposal, and of the last one
FIXED_POINT_STEPS = 6
_ONE, _HALF, _SIXTH, _24TH = (np.float32(1 / math.factorial(k)) for k in (1, 2, 3, 4))
_FREEDOM = 5.0  # of Student's law, whose tails cover the exponential ones of the density


@cache
def student_points(k: int) -> tuple[Float[np.ndarray, "3 points"], Float[np.ndarray, " points"]]:
    """Points of Student's law in k = 2 or 3 dimensions, and the log of its density there up to a constant."""
    uniform = stats.qmc.Sobol(k, scramble=True, seed=0).random(POINTS)
    radius = np.sqrt(k * stats.f.ppf(uniform[:, 0], k, _FREEDOM))
    height = 2 * uniform[:, 2] - 1 if k == 3 else np.zeros(POINTS)
    turn, across = 2 * np.pi * uniform[:, 1], np.sqrt(1 - height**2)
    points = radius * np.stack([across * np.cos(turn), across * np.sin(turn), height])
    log_density = -(_FREEDOM + k) / 2 * np.log1p(radius**2 / _FREEDOM)
    return points.astype(np.float32), log_density.astype(np.float32)


@compiled
def moments(views, u, points, log_density, radii, mean, covariance, inside):
    """Fills `mean` (metres) and `covariance` (square metres) of u with density exp(-energy), of which u is the mode.

    `inside` gets the probability of the ellipsoids of mean and covariance with these squared radii.

    Self-normalised importance sampling with fixed points of low discrepancy that follow Student's law with 5 degrees
    of freedom: 256 points about the mode, 256 with the mean and covariance found so far, then 2048 in the same way.
    The points are a fixed set, so that the same problem gives the same numbers. Relative error of the eigenvalues of
    the covariance, for two to eight cameras: median 0.3 %, 99 in 100 within 2 %, on a plane within 0.6 %. Where a
    tenth of the predictions contradicts the others, 97 in 100 are within 2 %.

    Source: own derivation; checked against closed forms and Markov chains in tests/fusion/test_moments.py.
    """
    slope, at_origin, a, own = views
    root, value = np.eye(3), np.empty(len(log_density), dtype=np.float32)
    L = factor(_averaged_precision(slope, at_origin, a, own, u))
    for j in range(3):
        root[:, j] = backward(L, root[:, j])
    mean[:] = u
    for points_used in (PILOT, PILOT, len(value)):
        here = mean, root, points, log_density, value[:points_used]
        first, second, total = _weighted(slope, at_origin, a, own, *here)
        if points_used == len(value):
            _probabilities(points, value, total, first, second, radii, inside)
        _move(mean, root, covariance, first, second)


@compiled
def _weighted(slope, at_origin, a, own, centre, root, points, log_density, value):
    """Mean and covariance of the points x, weighted by the density at centre + root x; fills `value` with weights.

    In float32, for twice the speed: what is rounded is the change of the energy with x, not the energy.
    """
    for p in range(len(value)):
        value[p] = -log_density[p]
    for c in range(len(a)):
        x, y, t = measured(slope[c], at_origin[c], centre)
        columns = change(slope[c], root[:, 0]), change(slope[c], root[:, 1]), change(slope[c], root[:, 2])
        _subtract_energy(x, y, t, columns, a[c], own[c], points, value)
    highest = value.max()
    for p in range(len(value)):
        # e^x = (e^(x/64))^64 by a polynomial, which vector units can do; to 1e-5 where the weight is not negligible
        x = max(value[p] - highest, np.float32(-80)) * np.float32(1 / 64)
        power = _ONE + x * (_ONE + x * (_HALF + x * (_SIXTH + x * _24TH)))
        for _ in range(6):
            power *= power
        value[p] = power
    total, m_0, m_1, m_2, c_00, c_10, c_11, c_20, c_21, c_22 = _sums(points, value)
    total = float(total)
    m_0, m_1, m_2 = m_0 / total, m_1 / total, m_2 / total
    c_00, c_10, c_11 = c_00 / total - m_0 * m_0, c_10 / total - m_1 * m_0, c_11 / total - m_1 * m_1
    c_20, c_21, c_22 = c_20 / total - m_2 * m_0, c_21 / total - m_2 * m_1, c_22 / total - m_2 * m_2
    return (m_0, m_1, m_2), (0.0, 0.0, 0.0, c_00, c_10, c_11, c_20, c_21, c_22), total


@njit(error_model="numpy", fastmath={"reassoc"})  # in any order: on all lanes of a vector unit
def _sums(points, weight):
    """The sums over the points of weight times 1, x and x x^T."""
    total = m_0 = m_1 = m_2 = c_00 = c_10 = c_11 = c_20 = c_21 = c_22 = np.float32(0)
    for p in range(len(weight)):
        x_0, x_1, x_2 = points[0, p], points[1, p], points[2, p]
        w_0, w_1, w_2 = weight[p] * x_0, weight[p] * x_1, weight[p] * x_2
        total += weight[p]
        m_0, m_1, m_2 = m_0 + w_0, m_1 + w_1, m_2 + w_2
        c_00, c_10, c_11 = c_00 + w_0 * x_0, c_10 + w_1 * x_0, c_11 + w_1 * x_1
        c_20, c_21, c_22 = c_20 + w_2 * x_0, c_21 + w_2 * x_1, c_22 + w_2 * x_2
    return total, m_0, m_1, m_2, c_00, c_10, c_11, c_20, c_21, c_22


@compiled
def _subtract_energy(x, y, t, columns, a, own, points, value):
    """Subtracts the energy of one camera at each point from its value; without a branch, for vector units."""
    (x_0, y_0, t_0), (x_1, y_1, t_1), (x_2, y_2, t_2) = columns
    x_0, x_1, x_2 = np.float32(x_0), np.float32(x_1), np.float32(x_2)
    y_0, y_1, y_2 = np.float32(y_0), np.float32(y_1), np.float32(y_2)
    t_0, t_1, t_2 = np.float32(t_0), np.float32(t_1), np.float32(t_2)
    x, y, beyond, a, own = np.float32(x), np.float32(y), np.float32(t - 1), np.float32(a), np.float32(own)
    for p in range(len(value)):
        p_0, p_1, p_2 = points[0, p], points[1, p], points[2, p]
        q_x = x + x_0 * p_0 + x_1 * p_1 + x_2 * p_2
        q_y = y + y_0 * p_0 + y_1 * p_1 + y_2 * p_2
        s = beyond + t_0 * p_0 + t_1 * p_1 + t_2 * p_2  # t - 1
        squared = q_x * q_x + q_y * q_y
        huber = math.sqrt(squared) - _HALF if squared > _ONE else _HALF * squared
        inverse = -s / (_ONE + s)  # 1/t - 1
        depth = max(s, inverse)
        if own > 0:
            g = (s - inverse) * _HALF
            depth = (s + inverse) * _HALF + g * g / (math.sqrt(g * g + own * own) + own)
        depth = depth if s > -_ONE else np.float32(np.inf)
        value[p] -= huber + a * depth


@compiled
def _probabilities(points, weight, total, first, second, radii, inside):
    """The weighted share of the points in each ellipsoid."""
    inside[:] = 0.0
    L = factor(second)
    for p in range(len(weight) if len(radii) else 0):
        offset = points[0, p] - first[0], points[1, p] - first[1], points[2, p] - first[2]
        squared = squared_norm(forward(L, offset))
        for level in range(len(radii)):
            if squared <= radii[level]:
                inside[level] += weight[p] / total


@compiled
def _move(mean, root, covariance, first, second):
    """Moves the mean to that of the points, and root to a root of their covariance; fills in that covariance."""
    l_00, l_10, l_11, l_20, l_21, l_22 = factor(second)
    for i in range(3):
        r_0, r_1, r_2 = root[i]
        mean[i] += r_0 * first[0] + r_1 * first[1] + r_2 * first[2]
        root[i] = r_0 * l_00 + r_1 * l_10 + r_2 * l_20, r_1 * l_11 + r_2 * l_21, r_2 * l_22
        for j in range(i + 1):
            product = root[i, 0] * root[j, 0] + root[i, 1] * root[j, 1] + root[i, 2] * root[j, 2]
            covariance[i, j] = covariance[j, i] = product


@compiled
def _averaged_precision(slope, at_origin, a, own, u):
    """About the second derivative of the energy averaged over N(u, its inverse), a fixed point; 1/square metres.

    For h the weight 1/sqrt(1 + E|q|^2); for a max(t, 1/t), t Gaussian with deviation s, its jump of slope at the kink
    times the density there, and its curvature before: a (2 N(1; t, s^2) + 2 P(T < 1)/t^3). A rounded mode widens the
    jump.

    Source: own derivation.
    """
    cameras = len(a)
    at, weight, bend = np.empty((cameras, 3)), np.empty(cameras), a.copy()
    for c in range(cameras):
        q_x, q_y, _ = at[c] = measured(slope[c], at_origin[c], u)
        weight[c] = 1 / math.sqrt(1 + q_x * q_x + q_y * q_y)
    for step in range(FIXED_POINT_STEPS + 1):
        H = ZERO
        for c in range(cameras):
            H = add(H, slope[c], 0.0, 0.0, 0.0, weight[c], 0.0, weight[c], bend[c])
        if step == FIXED_POINT_STEPS:
            break
        L = factor(H)
        for c in range(cameras):
            q_x, q_y, t = at[c]
            across = squared_norm(forward(L, slope[c, 0])) + squared_norm(forward(L, slope[c, 1]))
            deviation = max(math.sqrt(squared_norm(forward(L, slope[c, 2]))), TINY)
            standard, width = (1 - t) / deviation, math.hypot(deviation, own[c])
            at_kink = math.exp(-(((1 - t) / width) ** 2) / 2) / (width * math.sqrt(2 * math.pi))
            weight[c] = 1 / math.sqrt(1 + q_x * q_x + q_y * q_y + across)
            bend[c] = a[c] * (2 * at_kink + math.erfc(-standard / math.sqrt(2)) / (t * t * t))
    return H

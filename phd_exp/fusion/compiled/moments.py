"""As `phd_exp.fusion.moments`."""

import math
from typing import no_type_check

import numpy as np
from numba import prange

from phd_exp.fusion.compiled import TINY, compiled, on_all_cores
from phd_exp.fusion.compiled.linear import NOTHING, add, backward, factor, forward, moved_of, seen_of, squared
from phd_exp.fusion.moments import FIXED_POINT_STEPS, PASSES


@on_all_cores
@no_type_check
def moments(slope, at_origin, a, u, points, log_proposal, mean, covariance):
    """Fills the last two; points (3, points) of Student's law and its log density there."""
    for i in prange(len(a)):
        _moments(slope[i], at_origin[i], a[i], u[i], points, log_proposal, mean[i], covariance[i])


@compiled
@no_type_check
def _moments(slope, at_origin, a, u, points, log_proposal, mean, covariance):
    n = points.shape[1]
    offset, value = np.empty((3, n)), np.empty(n)
    L = factor(_averaged_precision(slope, at_origin, a, u))
    for p in range(n):
        offset[0, p], offset[1, p], offset[2, p] = backward(L, (points[0, p], points[1, p], points[2, p]))
    mean[:] = u
    found = _weighted(slope, at_origin, a, offset, log_proposal, value, mean)
    for _ in range(PASSES - 1):
        l_00, l_10, l_11, l_20, l_21, l_22 = factor(found)
        for p in range(n):
            offset[0, p] = l_00 * points[0, p]
            offset[1, p] = l_10 * points[0, p] + l_11 * points[1, p]
            offset[2, p] = l_20 * points[0, p] + l_21 * points[1, p] + l_22 * points[2, p]
        found = _weighted(slope, at_origin, a, offset, log_proposal, value, mean)
    covariance[0, 0], covariance[1, 1], covariance[2, 2] = found[3], found[5], found[8]
    covariance[1, 0] = covariance[0, 1] = found[4]
    covariance[2, 0] = covariance[0, 2] = found[6]
    covariance[2, 1] = covariance[1, 2] = found[7]


@compiled
@no_type_check
def _weighted(slope, at_origin, a, offset, log_proposal, value, mean):
    """Moves mean by the weighted mean of the offsets, and returns the covariance; `value` is overwritten."""
    value[:] = -log_proposal
    for c in range(len(a)):
        _subtract_energy(slope[c], seen_of(slope[c], at_origin[c], mean), a[c], offset, value)
    highest = value.max()
    total = m_0 = m_1 = m_2 = 0.0
    for p in range(len(value)):
        weight = value[p] = math.exp(value[p] - highest)
        total += weight
        m_0 += weight * offset[0, p]
        m_1 += weight * offset[1, p]
        m_2 += weight * offset[2, p]
    m_0, m_1, m_2 = m_0 / total, m_1 / total, m_2 / total
    mean[0] += m_0
    mean[1] += m_1
    mean[2] += m_2
    c_00 = c_10 = c_11 = c_20 = c_21 = c_22 = 0.0
    for p in range(len(value)):
        weight = value[p] / total
        d_0, d_1, d_2 = offset[0, p] - m_0, offset[1, p] - m_1, offset[2, p] - m_2
        c_00 += weight * d_0 * d_0
        c_10 += weight * d_1 * d_0
        c_11 += weight * d_1 * d_1
        c_20 += weight * d_2 * d_0
        c_21 += weight * d_2 * d_1
        c_22 += weight * d_2 * d_2
    return 0.0, 0.0, 0.0, c_00, c_10, c_11, c_20, c_21, c_22


@compiled
@no_type_check
def _subtract_energy(slope, centre, a, offset, value):
    """Take the energy of one camera at each point from its value; without a branch, for vector units."""
    c_x, c_y, c_t = centre
    for p in range(len(value)):
        q_x, q_y, t = moved_of(slope, (offset[0, p], offset[1, p], offset[2, p]))
        q_x, q_y, t = c_x + q_x, c_y + q_y, c_t + t
        squared = q_x * q_x + q_y * q_y
        huber = math.sqrt(squared) - 0.5 if squared > 1 else squared / 2
        depth = a * max(t, 1 / t) if t > 0 else np.inf
        value[p] -= huber + (depth if a > 0 else 0.0)


@compiled
@no_type_check
def _averaged_precision(slope, at_origin, a, u):
    """The second derivative of the energy averaged over N(u, its inverse)."""
    cameras = len(a)
    seen, weight, bend = np.empty((cameras, 3)), np.empty(cameras), a.copy()
    for c in range(cameras):
        q_x, q_y, _ = seen[c] = seen_of(slope[c], at_origin[c], u)
        weight[c] = 1 / math.sqrt(1 + q_x * q_x + q_y * q_y)
    H = _sum(slope, weight, bend)
    for _ in range(FIXED_POINT_STEPS):
        L = factor(H)
        for c in range(cameras):
            q_x, q_y, t = seen[c]
            across = squared(forward(L, slope[c, 0])) + squared(forward(L, slope[c, 1]))
            deviation = max(math.sqrt(squared(forward(L, slope[c, 2]))), TINY)
            standard = (1 - t) / deviation
            at_kink = math.exp(-standard * standard / 2) / (deviation * math.sqrt(2 * math.pi))
            weight[c] = 1 / math.sqrt(1 + q_x * q_x + q_y * q_y + across)
            bend[c] = a[c] * (2 * at_kink + math.erfc(-standard / math.sqrt(2)) / (t * t * t))
        H = _sum(slope, weight, bend)
    return H


@compiled
@no_type_check
def _sum(slope, weight, bend):
    sums = NOTHING
    for c in range(len(weight)):
        sums = add(sums, slope[c], 0.0, 0.0, 0.0, weight[c], 0.0, weight[c], bend[c])
    return sums

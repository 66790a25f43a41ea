"""Mean and covariance of a path: the Gaussian whose own averages of gradient and curvature agree with it.

A second derivative at the optimum misses the kinks of depth and the linear tails. Averaged over the Gaussian itself,
gradients vanish at its mean, and curvatures are its inverse covariance: that Gaussian is nearest to the density of
paths by the Kullback-Leibler divergence, and for Gaussian predictions it is the density.

Source: Opper and Archambeau, "The variational Gaussian approximation revisited" (2009); the averages of a camera are
an own derivation, checked against quadrature and simulated paths in tests/fusion/test_tracks_moments.py.
"""
# mypy: no-check-untyped-defs, allow-untyped-defs

import math

import numpy as np

from phd_exp.fusion.arithmetic import TINY, compiled, huber_weight
from phd_exp.fusion.tracks.energy import GAUSSIAN, add_camera, motion_energy
from phd_exp.fusion.tracks.newton import measure_all, newton_step
from phd_exp.fusion.tracks.tridiagonal import selected_inverse

STEPS = 8
LEAST_SHARE = 0.25  # of the depth: a Gaussian has a part behind the camera, where there is no density
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(5)
_WEIGHTS = _WEIGHTS / _WEIGHTS.sum()


@compiled
def gaussian(chain, work, mean, covariance):
    """Moves `mean` from the optimum to the mean, and fills `covariance` (N x d x d); `work.L` gets the factor."""
    covariance[:] = 0.0
    for step in range(STEPS):
        measure_all(chain, mean, work.at)
        motion_energy(chain, 1.0, mean, work.g)
        work.L[:] = work.motion
        for k in range(len(mean)):
            for c in range(chain.a.shape[1]):
                slope, a = chain.slope[k, c], chain.a[k, c]
                terms = averaged(work.at[k, c], spread(slope, covariance[k]), a, step == 0)
                add_camera(slope, *terms, work.g[k], work.L[k])
        newton_step(chain, work, mean)
        if step > 0:
            mean += work.dx
        selected_inverse(work.L, work.below, covariance)


@compiled
def freedom(chain, at, covariance, dof):
    """Fills `dof` (N x C) with how many of a frame's position unknowns each camera determines, at most 3.

    That is the trace of the averaged curvature times the covariance of (q_x, q_y, t) with the part of it that the
    position causes.
    """
    n = chain.slope.shape[3]
    for k in range(len(dof)):
        for c in range(dof.shape[1]):
            slope = chain.slope[k, c]
            _, _, _, xx, xy, yy, tt = averaged(at[k, c], spread(slope, covariance[k]), chain.a[k, c], False)
            dof[k, c] = 0.0
            for i in range(3):
                for j in range(n):
                    C = covariance[k, i, j]
                    x, y, t = slope[0, i] * C, slope[1, i] * C, slope[2, i] * C
                    dof[k, c] += xx * x * slope[0, j] + xy * (x * slope[1, j] + y * slope[0, j])
                    dof[k, c] += yy * y * slope[1, j] + tt * t * slope[2, j]


@compiled
def spread(slope, covariance):
    """Covariance of (q_x, q_y), and variance of t: xx, xy, yy, tt."""
    n = slope.shape[1]
    xx = xy = yy = tt = 0.0
    for i in range(n):
        for j in range(n):
            C = covariance[i, j]
            xx, xy = xx + slope[0, i] * C * slope[0, j], xy + slope[0, i] * C * slope[1, j]
            yy, tt = yy + slope[1, i] * C * slope[1, j], tt + slope[2, i] * C * slope[2, j]
    return xx, xy, yy, tt


@compiled
def averaged(at, spread, a, first):
    """Gradient and curvature of one camera, averaged over a Gaussian: by x, y, t; then xx, xy, yy, tt.

    Those of h by quadrature at 5 x 5 points. Those of max(t, 1/t) have, for t < 1, its derivatives at the mean of
    such t; the kink's curvature is twice the density at t = 1. Without a spread, in the `first` step, a kink counts
    as if it had a spread of about 1/a.
    """
    q_x, q_y, t = at
    if a == GAUSSIAN:
        return q_x, q_y, t, 1.0, 0.0, 1.0, 1.0
    if first:
        weight = 1 / math.sqrt(1 + q_x * q_x + q_y * q_y)
        return 0.0, 0.0, 0.0, weight, 0.0, weight, a * a / 2
    by_x, by_y, xx, xy, yy = _averaged_projection(q_x, q_y, spread)
    by_t, tt = _averaged_depth(t, math.sqrt(max(spread[3], TINY)))
    return by_x, by_y, a * by_t, xx, xy, yy, a * tt


@compiled
def _averaged_projection(q_x, q_y, spread):
    """Gradient and curvature of h(|q|), averaged."""
    root_xx = math.sqrt(max(spread[0], TINY))
    root_yx = spread[1] / root_xx
    root_yy = math.sqrt(max(spread[2] - root_yx * root_yx, 0.0))
    by_x = by_y = xx = xy = yy = 0.0
    for i in range(len(_NODES)):
        for j in range(len(_NODES)):
            p_x, p_y = q_x + root_xx * _NODES[i], q_y + root_yx * _NODES[i] + root_yy * _NODES[j]
            weight, unit_x, unit_y = huber_weight(p_x, p_y)
            share = weight * _WEIGHTS[i] * _WEIGHTS[j]
            by_x, by_y = by_x + share * p_x, by_y + share * p_y
            xx, xy = xx + share * (1 - unit_x * unit_x), xy - share * unit_x * unit_y
            yy += share * (1 - unit_y * unit_y)
    return by_x, by_y, xx, xy, yy


@compiled
def _averaged_depth(t, deviation):
    """First and second derivative of max(t, 1/t), averaged."""
    standard = (1 - t) / deviation
    density = math.exp(-standard * standard / 2) / (deviation * math.sqrt(2 * math.pi))
    below = math.erfc(-standard / math.sqrt(2)) / 2
    typical = t - deviation * deviation * density / below if below > 1e-9 else t  # the mean of T < 1
    typical = min(max(typical, LEAST_SHARE * t), 1.0)
    return 1 - below - below / (typical * typical), 2 * density + 2 * below / (typical * typical * typical)

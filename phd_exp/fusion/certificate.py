"""The error of an optimum, bounded by subgradients alone, independently of the method that found it."""
# mypy: no-check-untyped-defs, allow-untyped-defs

import math

import numpy as np

from phd_exp.fusion.arithmetic import (
    TINY,
    ZERO,
    add,
    compiled,
    factor,
    forward,
    huber_weight,
    measured,
    rounded_slopes,
    squared_norm,
)
from phd_exp.fusion.newton import KINK

RADII = (1e-8, 1e-6, 1e-4, 1e-2)  # metres; balls in which the curvature is bounded from below


@compiled
def certify(slope, at_origin, a, own, u, lam):
    """The norm of a subgradient at u, nats per metre; its ratio to sum a |dt/du|; the distance to the optimum, m.

    A subgradient of 0 proves the optimum. The distance is an upper bound for any lam in [-1, 1], infinite where the
    energy is too flat. Let G be the subgradient. At any other point u + d the energy is larger by at least

        G.d + d.H d/2 - e    while |d| <= rho,

    where H bounds the curvature from below within that radius. To it a kink adds 2 a (1 - |lam|)/(|r| rho) r r^T with
    r = dt/du, because its energy grows by a (1 - |lam|) |r.d|; and e = sum 3 a |t - 1| covers how far kinks are off.
    An optimum is no higher, so its d has |d| <= sqrt(tr H^(-1)) (|G| + sqrt(|G|^2 + 2 e)) with |G|^2 = G.H^(-1) G.
    If that is at most rho, it bounds the distance; by convexity no optimum lies outside the ball either. A larger
    ball has less curvature, hence a larger bound: the first radius that holds gives the best one.

    Source: own derivation; checked against a conic solver in tests/fusion/test_conic.py.
    """
    cameras = len(a)
    at, kink = np.empty((cameras, 3)), np.zeros(cameras, dtype=np.bool_)
    sums = ZERO
    pull = error = 0.0
    for c in range(cameras):
        q_x, q_y, t = at[c] = measured(slope[c], at_origin[c], u)
        kink[c] = own[c] == 0 and abs(t - 1) <= KINK and abs(lam[c]) < 1
        weight, _, _ = huber_weight(q_x, q_y)
        by_t = subgradient(t, own[c], lam[c], kink[c])
        sums = add(sums, slope[c], weight * q_x, weight * q_y, a[c] * by_t, 0.0, 0.0, 0.0, 0.0)
        pull += a[c] * math.sqrt(squared_norm(slope[c, 2]))
        error += 3 * a[c] * abs(t - 1) if kink[c] else 0.0
    distance = np.inf
    for radius in RADII:
        bound = _distance(_least_curvature(slope, at, a, own, lam, kink, radius), sums, error)
        if bound <= radius:
            distance = bound
            break
    norm = math.sqrt(squared_norm(sums))
    return norm, norm / pull, distance


@compiled
def subgradient(t, own, lam, is_at_kink):
    """A subgradient of the energy of depth over a."""
    if own > 0:
        return rounded_slopes(t, own)[0]
    return lam if is_at_kink else 1.0 if t >= 1 else -1 / (t * t)


@compiled
def _distance(curvature, G, error):
    """The bound from curvature, subgradient and error; NaN where the curvature is not positive definite."""
    L = factor(curvature)
    trace = squared_norm(forward(L, (1.0, 0.0, 0.0))) + squared_norm(forward(L, (0.0, 1.0, 0.0)))
    if curvature[8] != 0:  # three unknowns
        trace += squared_norm(forward(L, (0.0, 0.0, 1.0)))
    drop = squared_norm(forward(L, G))
    return math.sqrt(trace) * (math.sqrt(drop) + math.sqrt(drop + 2 * error))


@compiled
def _least_curvature(slope, at, a, own, lam, kink, radius):
    """A lower bound of the curvature within a radius of u.

    |q| changes by at most delta. Below 1 - delta, h has curvature 1; else at least (P - delta/|q|)/(|q| + delta).
    P projects across q, whose direction turns by at most asin(delta/|q|), and projectors differ in norm by the sine.
    The energy of depth has at least the curvature (1 - g/s)/t^3, which falls with t, plus width^2 g'^2/s^3 with the
    least g' and the largest s.
    """
    sums = ZERO
    for c in range(len(a)):
        xx, xy, yy, depth = least_curvature_of_camera(slope[c], at[c], a[c], own[c], lam[c], kink[c], radius)
        sums = add(sums, slope[c], 0.0, 0.0, 0.0, xx, xy, yy, depth)
    return sums


@compiled
def least_curvature_of_camera(slope, at, a, own, lam, is_at_kink, radius):
    """The bound of one camera, in (q_x, q_y) and in t."""
    q_x, q_y, t = at
    delta = radius * math.sqrt(squared_norm(slope[0]) + squared_norm(slope[1]))
    length = math.sqrt(q_x * q_x + q_y * q_y)
    xx, xy, yy = 1.0, 0.0, 1.0
    if length + delta >= 1:
        x, y, turn = q_x / max(length, 0.5), q_y / max(length, 0.5), delta / max(length, 0.5)
        scale = 1 / (length + delta) if turn < 1 else 0.0
        xx, xy, yy = scale * (1 - turn - x * x), -scale * x * y, scale * (1 - turn - y * y)
    reach = radius * math.sqrt(squared_norm(slope[2]))
    near, far = t - reach, t + reach
    depth = 2 / (far * far * far) if far < 1 else 0.0
    if own > 0:
        depth = _least_rounded_curvature(near, far, own) if near > 0 else 0.0
    elif is_at_kink:
        depth = 2 * (1 - abs(lam)) / max(reach, TINY)
    return xx, xy, yy, a * depth


@compiled
def _least_rounded_curvature(near, far, own):
    """A lower bound of the second derivative of the rounded energy of depth over a, between two depths."""
    g_near, g_far = (near - 1 / near) / 2, (far - 1 / far) / 2
    s_near, s_far = math.sqrt(g_near * g_near + own * own), math.sqrt(g_far * g_far + own * own)
    s, by_t = max(s_near, s_far), (1 + 1 / (far * far)) / 2
    share = own / s
    return (1 - g_far / s_far) / (far * far * far) + share * share * by_t * by_t / s

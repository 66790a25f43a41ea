"""The error of a path, bounded by subgradients alone, independently of the method that found it."""
# mypy: no-check-untyped-defs, allow-untyped-defs

import math

import numpy as np

from phd_exp.fusion.arithmetic import compiled, huber_weight
from phd_exp.fusion.certificate import RADII, least_curvature_of_camera, subgradient
from phd_exp.fusion.newton import KINK
from phd_exp.fusion.tracks.energy import add_camera, motion_energy
from phd_exp.fusion.tracks.newton import measure_all
from phd_exp.fusion.tracks.tridiagonal import factorise, forward, selected_inverse
from phd_exp.fusion.views import GAUSSIAN


@compiled
def certify(chain, work, x, lam, distance):
    """The bound on the gap to the lowest energy, nats; fills `distance` with that on each position's error, metres.

    Both hold for any x and any lam in [-1, 1], and are infinite where the energy is too flat. The bound of
    `phd_exp.fusion.certificate`, for all frames together: with a subgradient G, a curvature H that holds while no
    frame's position moves by more than rho, and e for kinks that are not exactly at t = 1, a lower energy
    at x + d needs

        G.d + d.H d/2 - e <= 0    so    d.H d <= (|G| + sqrt(|G|^2 + 2 e))^2 with |G|^2 = G.H^(-1) G

    while d_k moves less than rho, and the gap is at most |G|^2/2 + e. Frame k moves by at most the root of d.H d
    times the trace of its block of H^(-1). If that is less than rho in every frame, all holds, by convexity.

    Source: own derivation; checked against a conic solver in tests/fusion/test_tracks.py.
    """
    covariance = np.empty_like(work.L)
    measure_all(chain, x, work.at)
    motion_energy(chain, 1.0, x, work.pull)
    error = _subgradient(chain, work, lam, work.pull)
    for radius in RADII:
        work.L[:] = work.motion
        _add_least_curvature(chain, work, lam, radius)
        factorise(work.L, work.coupling, work.below)
        work.g[:] = work.pull
        forward(work.L, work.below, work.g)
        squared = (work.g * work.g).sum()
        reach = math.sqrt(squared) + math.sqrt(squared + 2 * error)
        selected_inverse(work.L, work.below, covariance)
        farthest = 0.0
        for k in range(len(x)):
            trace = covariance[k, 0, 0] + covariance[k, 1, 1] + covariance[k, 2, 2]
            distance[k] = math.sqrt(trace) * reach
            farthest = max(farthest, distance[k]) if trace >= 0 else np.inf
        if farthest <= radius:
            return squared / 2 + error
    distance[:] = np.inf
    return np.inf


@compiled
def _subgradient(chain, work, lam, G):
    """Adds the subgradients of the cameras to G; returns how much the energy at kinks may be lower than assumed."""
    error = 0.0
    nothing = np.zeros((3, 3))
    for k in range(len(lam)):
        for c in range(lam.shape[1]):
            q_x, q_y, t = work.at[k, c]
            a = chain.a[k, c]
            slope = chain.slope[k, c]
            if a == GAUSSIAN:
                add_camera(slope, q_x, q_y, t, 0.0, 0.0, 0.0, 0.0, G[k], nothing)
                continue
            own = chain.own[k, c]
            kink = own == 0 and abs(t - 1) <= KINK and abs(lam[k, c]) < 1
            weight = chain.p[k, c] * huber_weight(q_x, q_y)[0]
            by_t = subgradient(t, own, lam[k, c], kink)
            add_camera(slope, weight * q_x, weight * q_y, a * by_t, 0.0, 0.0, 0.0, 0.0, G[k], nothing)
            error += 3 * a * abs(t - 1) if kink else 0.0
    return error


@compiled
def _add_least_curvature(chain, work, lam, radius):
    """Adds a lower bound of the cameras' curvature while no frame's position moves by more than radius."""
    nothing = np.zeros(3)
    for k in range(len(lam)):
        for c in range(lam.shape[1]):
            slope, a, p, own = chain.slope[k, c], chain.a[k, c], chain.p[k, c], chain.own[k, c]
            if a == GAUSSIAN:
                add_camera(slope, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 1.0, nothing, work.L[k])
                continue
            is_at_kink = own == 0 and abs(work.at[k, c, 2] - 1) <= KINK and abs(lam[k, c]) < 1
            xx, xy, yy, tt = least_curvature_of_camera(slope, work.at[k, c], a, own, lam[k, c], is_at_kink, radius)
            add_camera(slope, 0.0, 0.0, 0.0, p * xx, p * xy, p * yy, tt, nothing, work.L[k])

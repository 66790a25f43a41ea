"""The most likely path, by the primal-dual Newton method of `phd_exp.fusion.newton` on all frames at once.

One step is a block tridiagonal system. Smoothing, duals, line search and the exact treatment of kinks are those of a
single position; all frames share the width of smoothing and the length of the step.

Source: own derivation; optima checked against a conic solver in tests/fusion/test_tracks.py.
"""
# mypy: no-check-untyped-defs, allow-untyped-defs

from typing import NamedTuple

import numpy as np

from phd_exp.fusion.arithmetic import compiled, huber_weight
from phd_exp.fusion.newton import (
    ARMIJO,
    EXACT_RIDGE,
    FARTHEST,
    FIRST_WIDTH,
    LEAST_DEPTHS,
    MOST_HALVINGS,
    MOST_STEPS,
    PENALTY,
    ROUNDS,
    SETTLED,
    SHRINK,
    STILL,
    WIDTH_FLOOR,
    exact_slopes,
)
from phd_exp.fusion.tracks.energy import (
    add_camera,
    add_smoothed,
    frames_energy,
    measure,
    motion_curvature,
    motion_energy,
    move_duals,
)
from phd_exp.fusion.tracks.tridiagonal import factorise, solve
from phd_exp.fusion.views import GAUSSIAN


class Work(NamedTuple):
    """Arrays that every step fills anew.

    Attributes:
        at: (q_x, q_y, t) of each camera, N x C x 3.
        moved: their change with the step.
        terms: what `move_duals` needs of each camera, N x C x 6.
        pull: gradient of the energy of the motion, N x d.
        g: gradient of the whole energy.
        dx: the step.
        motion: diagonal blocks of the curvature of the motion, N x d x d.
        coupling: its blocks of neighbouring frames, N-1 x d x d.
        L: diagonal blocks of the whole curvature, then of its factor.
        below: blocks of the factor below the diagonal.
    """

    at: np.ndarray
    moved: np.ndarray
    terms: np.ndarray
    pull: np.ndarray
    g: np.ndarray
    dx: np.ndarray
    motion: np.ndarray
    coupling: np.ndarray
    L: np.ndarray
    below: np.ndarray


@compiled
def workspace(chain):
    """The arrays for this chain, with the curvature of its motion."""
    frames, cameras = chain.a.shape
    d = len(chain.mean)
    motion, coupling = np.empty((frames, d, d)), np.empty((frames - 1, d, d))
    motion_curvature(chain, motion, coupling)
    views = np.zeros((frames, cameras, 3)), np.zeros((frames, cameras, 3)), np.zeros((frames, cameras, 6))
    vectors = np.empty((frames, d)), np.empty((frames, d)), np.empty((frames, d))
    return Work(*views, *vectors, motion, coupling, np.empty((frames, d, d)), np.empty((frames - 1, d, d)))


@compiled
def measure_all(chain, x, at):
    """Fills `at` with (q_x, q_y, t) of every camera."""
    at[:] = chain.at_origin
    measure(chain.slope, x, at)


@compiled
def newton_step(work):
    """Fills `dx` with the step of the gradient g and the curvature L, which becomes its factor."""
    factorise(work.L, work.coupling, work.below)
    work.dx[:] = -work.g
    solve(work.L, work.below, work.dx)


@compiled
def optimum(chain, work, x, lam):
    """Moves x to the optimum and lam to its multipliers; returns whether one has t >= 1e-6 in every camera."""
    start = x.copy()
    for least in LEAST_DEPTHS:
        x[:] = start
        lam[:] = 0.0
        minimise(chain, work, x, lam, least)
        if nearest(work.at, chain.a) >= least:
            return True
    return False


@compiled
def nearest(at, a):
    """The least t of all cameras that are not Gaussian; NaN if one is NaN."""
    least = np.inf
    for k in range(len(a)):
        for c in range(a.shape[1]):
            if a[k, c] != GAUSSIAN and not at[k, c, 2] >= least:
                least = at[k, c, 2]
    return least


@compiled
def minimise(chain, work, x, lam, least):
    """Moves x to the minimum with 1/t continued below t = least, and lam to the multipliers of the kinks.

    It stops after 80 steps at the latest.
    """
    y = np.zeros((*lam.shape, 2))
    width = FIRST_WIDTH
    measure_all(chain, x, work.at)
    for _ in range(MOST_STEPS):
        before = _linearise_smoothed(chain, work, x, y, lam, width, least)
        newton_step(work)
        share = _line_search(chain, work, before, width, least)
        settled = _move(chain, work, y, lam, share)
        x += share * work.dx
        measure_all(chain, x, work.at)
        if width == WIDTH_FLOOR and settled:
            break
        width = max(width * SHRINK, WIDTH_FLOOR)


@compiled
def _linearise_smoothed(chain, work, x, y, lam, width, least):
    """The energy of the motion; fills gradients and curvature of the smoothed energy."""
    motion = motion_energy(chain, 1.0, x, work.pull)
    work.g[:] = work.pull
    work.L[:] = work.motion
    for k in range(len(x)):
        for c in range(chain.a.shape[1]):
            views = chain.slope[k, c], work.at[k, c], chain.a[k, c], chain.p[k, c], chain.own[k, c]
            add_smoothed(*views, y[k, c], lam[k, c], width, least, work.terms[k, c], work.g[k], work.L[k])
    return motion


@compiled
def _line_search(chain, work, motion, width, least):
    """The share of the step to take: halved until the energy falls by Armijo's rule; `motion` is that before."""
    work.moved[:] = 0.0
    measure(chain.slope, work.dx, work.moved)
    descent, by_motion = (work.g * work.dx).sum(), (work.pull * work.dx).sum()
    bend = motion_energy(chain, 0.0, work.dx, work.pull)
    before = motion + frames_energy(chain, work.at, work.moved, 0.0, width, least)
    enough = before + 1e-12 * abs(before)  # rounding may add this much where nothing is left to gain
    share = 1.0
    for _ in range(MOST_HALVINGS):
        value = motion + share * (by_motion + share * bend)
        value += frames_energy(chain, work.at, work.moved, share, width, least)
        if not value > enough + ARMIJO * share * descent:
            break
        share /= 2
    return share


@compiled
def _move(chain, work, y, lam, share):
    """Moves the duals; returns whether (q_x, q_y, t) hardly moved in any camera."""
    settled = True
    at, moved = work.at, work.moved
    for k in range(len(lam)):
        for c in range(lam.shape[1]):
            lam[k, c] = move_duals(at[k, c], work.terms[k, c], moved[k, c], y[k, c], lam[k, c], chain.a[k, c])
            for m in range(3):
                settled &= abs(share * moved[k, c, m]) <= SETTLED * (1 + abs(at[k, c, m]))
    return settled


@compiled
def polish(chain, work, x, lam):
    """Moves x to the optimum, to rounding, and lam to the subgradients of max(t, 1/t) at kinks.

    The method of multipliers, as `phd_exp.fusion.newton.polish`. A result farther away than 0.1 mm is rejected.
    """
    start, first = x.copy(), lam.copy()
    kink = np.zeros(lam.shape, dtype=np.bool_)
    for _ in range(ROUNDS):
        _linearise_exact(chain, work, x, lam, kink)
        newton_step(work)
        x += work.dx
        measure_all(chain, x, work.at)
        for k in range(len(x)):
            for c in range(lam.shape[1]):
                lam[k, c] += PENALTY * (work.at[k, c, 2] - 1) if kink[k, c] else 0.0
        if np.abs(work.dx).max() <= STILL:
            break
    if not np.all(np.abs(x - start) <= FARTHEST):  # NaN too
        x[:] = start
        lam[:] = first
    lam[:] = np.minimum(np.maximum(lam, -1.0), 1.0)


@compiled
def _linearise_exact(chain, work, x, lam, kink):
    """Fills gradient and curvature of the exact energy."""
    measure_all(chain, x, work.at)
    motion_energy(chain, 1.0, x, work.g)
    work.L[:] = work.motion
    for k in range(len(x)):
        for c in range(lam.shape[1]):
            _add_exact(chain, work, k, c, lam, kink)


@compiled
def _add_exact(chain, work, k, c, lam, kink):
    """Adds gradient and curvature of one camera; marks it if it is at its kink, else sets lam to its side."""
    slope, g, L = chain.slope[k, c], work.g[k], work.L[k]
    q_x, q_y, t = work.at[k, c]
    a = chain.a[k, c]
    if a == GAUSSIAN:
        add_camera(slope, q_x, q_y, t, 1.0, 0.0, 1.0, 1.0, g, L)
        return
    kink[k, c], lam[k, c], by_t, bend = exact_slopes(t, chain.own[k, c], lam[k, c])
    weight, unit_x, unit_y = huber_weight(q_x, q_y)
    weight *= chain.p[k, c]
    xx, xy = weight * (1 + EXACT_RIDGE - unit_x * unit_x), -weight * unit_x * unit_y
    yy, tt = weight * (1 + EXACT_RIDGE - unit_y * unit_y), a * (bend + EXACT_RIDGE)
    add_camera(slope, weight * q_x, weight * q_y, a * by_t, xx, xy, yy, tt, g, L)

"""The compiled loops over the problems of a batch, each problem on one core."""
# mypy: no-check-untyped-defs, allow-untyped-defs

import hashlib
from pathlib import Path

import numpy as np
from numba import njit, prange

from phd_exp.fusion.arithmetic import compiled, depth_excess, huber, measured
from phd_exp.fusion.moments import moments
from phd_exp.fusion.newton import optimum, polish, subgradient
from phd_exp.fusion.views import Status

CONVERGED = 1e-6  # the largest relative subgradient at which a problem counts as solved
_FUSED, _NOT_CONVERGED = int(Status.FUSED), int(Status.NOT_CONVERGED)
_NO_COMMON_VIEW, _PLANE_BEHIND_CAMERA = int(Status.NO_COMMON_VIEW), int(Status.PLANE_BEHIND_CAMERA)


@compiled
def _solve(slope, at_origin, a, own, free_slope, u, gradient, excess):
    """Moves u to the optimum of one problem; returns its status."""
    lam = np.zeros(len(a))
    if not optimum(slope, at_origin, a, own, u, lam):
        visible = optimum(free_slope, at_origin, a, own, np.zeros(3), lam)
        return _PLANE_BEHIND_CAMERA if visible else _NO_COMMON_VIEW
    polish(slope, at_origin, a, own, u, lam)
    gradient[:] = subgradient(slope, at_origin, a, own, u, lam)
    for c in range(len(a)):
        q_x, q_y, t = measured(slope[c], at_origin[c], u)
        excess[c] = huber(q_x * q_x + q_y * q_y) + a[c] * depth_excess(t, own[c])
    return _FUSED if gradient[1] <= CONVERGED else _NOT_CONVERGED


def _loops(sources):
    """The two loops, compiled from these sources.

    numba's cache depends on this file and on the variables that a function closes over. The digest of all sources is
    therefore one of them.
    """

    @njit(cache=True, error_model="numpy", parallel=True)
    def solve(slope, at_origin, a, own, free_slope, status, u, gradient, excess):
        """Solves the problems whose status is FUSED, from u, and sets their status.

        `free_slope` is the slope without the plane. Fills `gradient` with what `subgradient` returns, and
        `excess` with the energy of u in each camera above the camera's lowest.
        """
        assert len(sources) > 0
        for i in prange(len(a)):
            if status[i] == _FUSED:
                views = slope[i], at_origin[i], a[i], own[i]
                status[i] = _solve(*views, free_slope[i], u[i], gradient[i], excess[i])

    @njit(cache=True, error_model="numpy", parallel=True)
    def all_moments(chosen, slope, at_origin, a, own, u, points, log_density, radii, mean, covariance, inside):
        """Calls `moments` for the chosen problems."""
        assert len(sources) > 0
        for i in prange(len(a)):
            if chosen[i]:
                views = slope[i], at_origin[i], a[i], own[i]
                moments(views, u[i], points, log_density, radii, mean[i], covariance[i], inside[i])

    return solve, all_moments


_SOURCES = b"".join(source.read_bytes() for source in sorted(Path(__file__).parent.glob("*.py")))
solve, all_moments = _loops(hashlib.sha256(_SOURCES).hexdigest())

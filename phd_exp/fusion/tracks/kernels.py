"""The compiled functions that Python calls, for one path each."""
# mypy: no-check-untyped-defs, allow-untyped-defs

import hashlib
from pathlib import Path

from numba import njit

from phd_exp.fusion import arithmetic, views
from phd_exp.fusion import newton as fusion_newton
from phd_exp.fusion.newton import LEAST_DEPTHS
from phd_exp.fusion.tracks import energy, gaussian, newton, tridiagonal
from phd_exp.fusion.tracks.energy import camera_energy, measure
from phd_exp.fusion.tracks.gaussian import propagate
from phd_exp.fusion.tracks.newton import optimum, polish, workspace


def _functions(sources):
    """The functions, compiled from these sources; see `phd_exp.fusion.kernels`."""

    @njit(cache=True, error_model="numpy")
    def most_likely(chain, x, lam):
        """Moves x to the optimum and lam to its multipliers; returns whether it is in front of all cameras."""
        assert len(sources) > 0
        work = workspace(chain)
        found = optimum(chain, work, x, lam)
        if found:
            polish(chain, work, x, lam)
        return found

    @njit(cache=True, error_model="numpy")
    def excesses(slope, at_origin, a, own, x, found):
        """Fills in the energy of each camera at x above its lowest, without weights."""
        assert len(sources) > 0
        at = at_origin.copy()
        measure(slope, x, at)
        for k in range(len(a)):
            for c in range(a.shape[1]):
                q_x, q_y, t = at[k, c]
                energy = camera_energy(q_x, q_y, t, a[k, c], 1.0, own[k, c], 0.0, LEAST_DEPTHS[-1])
                found[k, c] = energy - max(a[k, c], 0.0) * (1 + own[k, c])

    @njit(cache=True, error_model="numpy")
    def moments(chain, mean, covariance, factors):
        """Calls `propagate`."""
        assert len(sources) > 0
        return propagate(chain, workspace(chain), mean, covariance, factors)

    return most_likely, excesses, moments


_COMPILED = (arithmetic, views, fusion_newton, energy, gaussian, newton, tridiagonal)
_SOURCES = b"".join(Path(str(module.__file__)).read_bytes() for module in _COMPILED)
most_likely, excesses, moments = _functions(hashlib.sha256(_SOURCES).hexdigest())

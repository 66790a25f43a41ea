"""The compiled functions that Python calls, for one path each."""
# mypy: no-check-untyped-defs, allow-untyped-defs

import hashlib
from pathlib import Path

import numpy as np
from numba import njit

from phd_exp.fusion import arithmetic
from phd_exp.fusion import certificate as fusion_certificate
from phd_exp.fusion import newton as fusion_newton
from phd_exp.fusion.tracks import certificate, energy, gaussian, newton, tridiagonal
from phd_exp.fusion.tracks.certificate import certify
from phd_exp.fusion.tracks.energy import frames_energy, motion_energy
from phd_exp.fusion.tracks.gaussian import propagate
from phd_exp.fusion.tracks.newton import measure_all, optimum, polish, workspace


def _functions(sources):
    """Both functions, compiled from these sources; see `phd_exp.fusion.kernels`."""

    @njit(cache=True, error_model="numpy")
    def most_likely(chain, x, distance):
        """Moves x to the optimum; returns whether a position is in front of all cameras, the energy and its bound.

        Fills `distance` with the bounds of `certify`.
        """
        assert len(sources) > 0
        work, lam = workspace(chain), np.zeros(chain.a.shape)
        if not optimum(chain, work, x, lam):
            return False, np.nan, np.inf
        polish(chain, work, x, lam)
        gap = certify(chain, work, x, lam, distance)
        measure_all(chain, x, work.at)
        motion = motion_energy(chain, 1.0, x, work.g)
        return True, motion + frames_energy(chain, work.at, work.at, 0.0, 0.0, 1e-6), gap

    @njit(cache=True, error_model="numpy")
    def moments(chain, mean, covariance, factors):
        """Calls `propagate`."""
        assert len(sources) > 0
        return propagate(chain, workspace(chain), mean, covariance, factors)

    return most_likely, moments


_COMPILED = (arithmetic, fusion_newton, fusion_certificate, certificate, energy, gaussian, newton, tridiagonal)
_SOURCES = b"".join(Path(str(module.__file__)).read_bytes() for module in _COMPILED)
most_likely, moments = _functions(hashlib.sha256(_SOURCES).hexdigest())

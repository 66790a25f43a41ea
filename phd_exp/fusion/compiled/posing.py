"""As `phd_exp.fusion.problems`: what cameras see of origin + directions u, and whether they can be asked at all."""

from typing import no_type_check

import numpy as np
from numba import prange

from phd_exp.fusion.compiled import compiled, on_all_cores
from phd_exp.fusion.pose import RIGID_WITHIN


@on_all_cores
@no_type_check
def soundness(to_seen, mode, a, R, t, sound, rigid):
    """Fills sound (every number is finite, a and the depth positive) and rigid (R is a rotation)."""
    for i in prange(len(a)):
        for c in range(a.shape[1]):
            # 0 times infinity or NaN is NaN, and so is a sum with it
            total = 0.0
            for m in range(3):
                total += 0 * mode[i, c, m] + 0 * t[i, c, m]
                for n in range(3):
                    total += 0 * to_seen[i, c, m, n] + 0 * R[i, c, m, n]
            positive = np.isfinite(a[i, c]) and a[i, c] > 0 and mode[i, c, 2] > 0
            sound[i, c] = total == 0 and positive
            rigid[i, c] = _is_rotation(R[i, c])


@compiled
@no_type_check
def _is_rotation(R):
    for m in range(3):
        for n in range(m + 1):
            product = R[m, 0] * R[n, 0] + R[m, 1] * R[n, 1] + R[m, 2] * R[n, 2]
            if not abs(product - (1.0 if m == n else 0.0)) <= RIGID_WITHIN:  # NaN too
                return False
    handed = R[0, 0] * (R[1, 1] * R[2, 2] - R[1, 2] * R[2, 1])
    handed += R[0, 1] * (R[1, 2] * R[2, 0] - R[1, 0] * R[2, 2])
    handed += R[0, 2] * (R[1, 0] * R[2, 1] - R[1, 1] * R[2, 0])
    return handed > 0


@on_all_cores
@no_type_check
def views(to_seen, R, t, mask, origin, directions, slope, at_origin):
    """Fills slope and at_origin."""
    n, cameras = mask.shape
    for i in prange(n):
        for c in range(cameras):
            for m in range(3):
                at_origin[i, c, m] = 1.0 if m == 2 else 0.0
                slope[i, c, m, :] = 0.0
            if not mask[i, c]:
                continue
            at_origin[i, c, 2] = 0.0
            for m in range(3):
                seen = to_seen[i, c, m]
                at_origin[i, c, m] += seen[0] * t[i, c, 0] + seen[1] * t[i, c, 1] + seen[2] * t[i, c, 2]
                for world in range(3):
                    turned = (
                        seen[0] * R[i, c, 0, world]
                        + seen[1] * R[i, c, 1, world]
                        + seen[2] * R[i, c, 2, world]
                    )
                    at_origin[i, c, m] += turned * origin[i, world]
                    for j in range(directions.shape[2]):
                        slope[i, c, m, j] += turned * directions[i, world, j]

"""As `phd_exp.fusion.problems`: what cameras see of origin + directions u."""

from typing import no_type_check

from numba import prange

from phd_exp.fusion.compiled import on_all_cores


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

"""The chain of a path: the unknowns of each frame, what cameras measure of them, and how they move.

The unknowns of a frame are the position (relative to an origin, metres), the slow errors, the velocity, and the
acceleration if the motion has one. Cameras measure position and slow errors, which come first.
"""

import numpy as np
from jaxtyping import Float

from phd_exp.fusion.tracks.frames import Frames
from phd_exp.fusion.tracks.motion import Motion, transitions
from phd_exp.fusion.tracks.slow import Slow

Array = np.ndarray


def unknowns(motion: Motion, slow: Slow, cameras: int) -> tuple[int, int]:
    """The number of unknowns that are measured, and that of all."""
    n = 3 + len(slow.times(cameras))
    return n, n + 3 * (motion.order - 1)


def measured(
    frames: Frames,
    slow: Slow,
    deviation: Float[Array, "frames cameras"],
    about: Float[Array, "frames 3"],
    level: Float[Array, " frames"],
) -> tuple[Float[Array, "frames cameras 3 n"], Float[Array, "frames cameras 3"]]:
    """Slopes and values at the origin, in which the slow factor is linear about a path and its level.

    Of the position v in its frame a camera measures v e^(-d s), with the standard deviation d of the slow log depth
    and s of variance 1. About v = r and s = s_r that is e^(-d s_r) (v - d (s - s_r) r) but for terms of second
    order, and affine in (v, s): the energy is convex in all unknowns. The slow offset adds to q.
    """
    cameras = frames.a.shape[1]
    shrunk = np.exp(-deviation * level[:, None])[..., None]
    at_origin = frames.at_origin + (1 - shrunk) * (frames.slope @ frames.centres[..., None])[..., 0]
    parts = [shrunk[..., None] * frames.slope]
    if slow.depth_share:
        along = -deviation[..., None] * (parts[0] @ (about[:, None] - frames.centres)[..., None])[..., 0]
        at_origin = at_origin - along * level[:, None, None]
        parts.append(along[..., None])
    if slow.projection_share:
        offsets = np.zeros((*frames.a.shape, 3, 2 * cameras))
        for c in range(cameras):
            offsets[:, c, [0, 1], [2 * c, 2 * c + 1]] = -slow.offset * frames.mask[:, c, None]
        parts.append(offsets)
    return np.ascontiguousarray(np.concatenate(parts, -1)), np.ascontiguousarray(at_origin)


def moving(
    motion: Motion, slow: Slow, cameras: int, steps: Float[Array, " steps"]
) -> tuple[Float[Array, "steps d d"], Float[Array, "steps d d"]]:
    """F and W of these times between frames (seconds)."""
    n, d = unknowns(motion, slow, cameras)
    F, W = np.zeros((2, len(steps), d, d))
    for axis in range(3):
        of_axis = [axis, *(n + 3 * i + axis for i in range(motion.order - 1))]
        F[(slice(None), *np.ix_(of_axis, of_axis))], W[(slice(None), *np.ix_(of_axis, of_axis))] = transitions(
            motion, steps
        )
    for i, time in enumerate(slow.times(cameras), start=3):
        F[:, i, i], W[:, i, i] = np.exp(-steps / time), -1 / np.expm1(-2 * steps / time)
    return F, W


def start(motion: Motion, slow: Slow, cameras: int) -> tuple[Float[Array, " d"], Float[Array, "d d"]]:
    """Mean and precision of the first frame's unknowns before any prediction; nothing is known of the position."""
    n, d = unknowns(motion, slow, cameras)
    variances = np.repeat(np.array(motion.deviations) ** 2, 3)
    return np.zeros(d), np.diag(np.concatenate([np.zeros(3), np.ones(n - 3), 1 / variances]))

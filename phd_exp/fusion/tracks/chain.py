"""The chain of a path: the unknowns of each frame, what cameras measure of them, and how they move.

The unknowns of a frame are the position (relative to an origin, metres), the slow errors, the velocity, and the
acceleration if the motion has one. Cameras measure position and slow errors, which come first.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from phd_exp.fusion.tracks.frames import Frames
from phd_exp.fusion.tracks.motion import Motion, transitions
from phd_exp.fusion.tracks.slow import Slow

Array = np.ndarray


@dataclass(frozen=True)
class Model:
    """The law of the unknowns, and what cameras measure of them.

    Args:
        motion: of the object.
        slow: the errors that consecutive frames share.
        cameras: their number.
    """

    motion: Motion
    slow: Slow
    cameras: int

    @property
    def measured_unknowns(self) -> int:
        """n, the number of unknowns that cameras measure."""
        return 3 + len(self.slow.times(self.cameras))

    @property
    def velocity(self) -> slice:
        """Where the unknowns have the velocity."""
        return slice(self.measured_unknowns, self.measured_unknowns + 3)

    def start(self) -> tuple[Float[Array, " d"], Float[Array, "d d"]]:
        """Mean and precision of the first frame's unknowns before any prediction; the position is not known."""
        variances = np.repeat(np.array(self.motion.deviations) ** 2, 3)
        slow = np.ones(self.measured_unknowns - 3)
        precision = np.concatenate([np.zeros(3), slow, 1 / variances])
        return np.zeros(len(precision)), np.diag(precision)

    def moving(self, steps: Float[Array, " steps"]) -> tuple[Float[Array, "steps d d"], Float[Array, "steps d d"]]:
        """F and W of these times between frames (seconds)."""
        n, order = self.measured_unknowns, self.motion.order
        d = n + 3 * (order - 1)
        F, W = np.zeros((2, len(steps), d, d))
        F_axis, W_axis = transitions(self.motion, steps)
        for axis in range(3):
            places = np.array([axis, *range(n + axis, d, 3)])
            rows, columns = places[:, None], places[None]
            F[:, rows, columns], W[:, rows, columns] = F_axis, W_axis
        for i, time in enumerate(self.slow.times(self.cameras), start=3):
            F[:, i, i], W[:, i, i] = np.exp(-steps / time), -1 / np.expm1(-2 * steps / time)
        return F, W

    def measured(
        self, frames: Frames, about: Float[Array, "frames d"]
    ) -> tuple[Float[Array, "frames cameras 3 n"], Float[Array, "frames cameras 3"]]:
        """Slopes and values at the origin; the slow factor is linear about these unknowns.

        Of the position v in its frame a camera measures v e^(-d s), with the standard deviation d of the slow log
        depth and s of variance 1. About v = r and s = s_r that is e^(-d s_r) (v - d (s - s_r) r) but for terms of
        second order, and affine in (v, s): the energy is convex in all unknowns. The slow offset adds to q.
        """
        parts, at_origin = [frames.slope], frames.at_origin
        if self.slow.depth_share:
            d, level = frames.deviation[..., None], about[:, 3, None, None]
            shrunk = np.exp(-d * level)
            at_origin = at_origin + (1 - shrunk) * (frames.slope @ frames.centres[..., None])[..., 0]
            by_position = shrunk[..., None] * frames.slope
            along = -d * (by_position @ (about[:, None, :3] - frames.centres)[..., None])[..., 0]
            at_origin = at_origin - along * level
            parts = [by_position, along[..., None]]
        if self.slow.projection_share:
            offsets = np.zeros((*frames.a.shape, 3, 2 * self.cameras))
            for c in range(self.cameras):
                offsets[:, c, [0, 1], [2 * c, 2 * c + 1]] = -self.slow.offset * frames.mask[:, c, None]
            parts.append(offsets)
        return np.ascontiguousarray(np.concatenate(parts, -1)), np.ascontiguousarray(at_origin)

"""A live path: the state of each frame a fixed number of frames later, in constant time for each frame."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from phd_exp.fusion.pose import Pose
from phd_exp.fusion.tracks.chain import VELOCITY, Array, moving, start
from phd_exp.fusion.tracks.frames import Frames
from phd_exp.fusion.tracks.lost import USUAL, Lost
from phd_exp.fusion.tracks.motion import Motion
from phd_exp.fusion.tracks.shear import sheared
from phd_exp.fusion.tracks.slow import NONE, Slow
from phd_exp.fusion.tracks.solved import Solved, levels, solve
from phd_exp.fusion.tracks.track import viewed
from phd_exp.fusion.views import Affine, Views
from phd_exp.hardware import one_thread


@dataclass(frozen=True)
class State:
    """One frame of a path, given all frames up to `lag` later; as in `Path`.

    Args:
        time: of the frame, seconds.
        point: the most likely position, metres.
        velocity: of the most likely path, metres per second.
        mean: the expected position, metres.
        covariance: of the position, square metres.
        velocity_covariance: square metres per square second.
        excess: energy of the position in each view above the view's lowest energy, nats.
        a: precision of each view's depth.
        own: the width of the rounded mode of each view's t = z/mu_z; 0 for a kink.
    """

    time: float
    point: Float[Tensor, "3"]
    velocity: Float[Tensor, "3"]
    mean: Float[Tensor, "3"]
    covariance: Float[Tensor, "3 3"]
    velocity_covariance: Float[Tensor, "3 3"]
    excess: Float[Tensor, " cameras"]
    a: Float[Tensor, " cameras"]
    own: Float[Tensor, " cameras"]

    @property
    def surprise(self) -> Float[Tensor, " cameras"]:
        """Credible level of the position in each view, near 1 where they contradict; NaN where masked out."""
        level = torch.from_numpy(levels(self.excess.numpy(), self.a.numpy(), self.own.numpy()))
        return level.masked_fill(self.a == 0, torch.nan)


class Tracker:
    """Smooths a path frame by frame.

    The last `lag` + 1 frames are solved anew with each frame. Older ones are replaced by their Gaussian factors, see
    `phd_exp.fusion.tracks.gaussian`, which is exact for Gaussian predictions.

    Args:
        motion: `ConstantVelocity` or `ConstantAcceleration`.
        lag: how many later frames the state of a frame takes into account; 0 gives a filter.
        slow: correlation times of errors (default: independent frames). This needs a lag of at least 1, because the
            next frame changes the weight of a frame.
        lost: when the track ends.

    Attributes:
        lost_because: when and why the track ended, else None. Then `update` returns None, and `finish` the states up
            to there; begin a new Tracker.

    Raises:
        ValueError: lag is less than 0, or 1 with slow errors, or less than the contradictions that end a track need.

    Examples:
        >>> import torch
        >>> from phd_exp.distributions import ProjectedHuber
        >>> from phd_exp.fusion import Pose
        >>> from phd_exp.fusion.tracks import ConstantVelocity, Lost, Tracker
        >>> tracker = Tracker(ConstantVelocity(noise=1.0), lag=1, lost=Lost(contradictions=2))
        >>> A, a, here = 300 * torch.eye(2)[None], torch.tensor([20.0]), Pose(torch.eye(3), torch.zeros(3))
        >>> for frame in range(3):
        ...     prediction = ProjectedHuber(torch.zeros(1, 2), torch.tensor([4.0 + frame]), A, a)
        ...     state = tracker.update(float(frame), prediction, here)
        >>> state.time, bool(0.9 < state.velocity[2] < 1.1)
        (1.0, True)
    """

    def __init__(self, motion: Motion, lag: int = 10, slow: Slow = NONE, lost: Lost = USUAL) -> None:
        if lag < (least := int(slow != NONE)):
            raise ValueError(f"lag: got {lag}; expected a number of frames, at least {least}")
        if lost.contradictions > lag + 1:
            raise ValueError(
                f"lost.contradictions: got {lost.contradictions}; expected at most lag + 1 = {lag + 1} frames"
            )
        self.motion, self.lag, self.slow, self.lost = motion, lag, slow, lost
        self.lost_because: str | None = None
        self._window: Solved | None = None
        self._seen = -np.inf  # the last time with a prediction
        self._given = False  # whether `update` has returned the state of the window's first frame
        self._end: int | None = None  # the frames of the window that belong to the track, all by default

    @torch.no_grad()
    def update(
        self, time: float, predictions: Affine, pose: Pose, mask: Bool[Tensor, " cameras"] | None = None
    ) -> State | None:
        """The state `lag` frames before this one; None until there is one, and after the track is lost.

        Args:
            time: of this frame, later than that of the frame before, seconds.
            predictions: ProjectedHuber, or `Gaussian`, of batch shape (cameras,).
            pose: of each camera; its batch shape broadcasts to that.
            mask: which cameras take part (default: all). A frame without any is bridged.

        Raises:
            ValueError: an argument is not valid.
        """
        if self.lost_because is not None:
            return None
        window, seen = self._window, mask is None or bool(mask.any())
        if window is not None and not time > window.frames.times[-1]:
            raise ValueError(f"time: got {time} after {window.frames.times[-1]}; expected a later time")
        if window is not None and time - self._seen > self.lost.after:
            self.lost_because = self.lost.late(self._seen)
            return None
        with one_thread():
            views = viewed(predictions, pose, mask, self.slow) if seen else None
            if window is not None:
                window = self._next(window, time, views)
            elif views is not None:
                window = self._first(time, views)
            else:
                return None
            self._window, self._seen = window, time if seen else self._seen
            full = len(window.x) == self.lag + 1
            self._end, self.lost_because = self.lost.contradicted(window, full)
            self._given = full and self.lost_because is None
            return self._state(0) if self._given else None

    def finish(self) -> list[State]:
        """The states of the last frames of the track, for which `update` has not returned one."""
        if self._window is None:
            return []
        frames = len(self._window.frames.times[: self._end])
        return [self._state(k) for k in range(int(self._given), frames)]

    def position(self, time: float) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
        """Expected position (metres) and its covariance (square metres) at a time, given all frames so far.

        The time is that of one of the last `lag` + 1 frames, or later. Raises ValueError before the first frame.
        """
        if (window := self._window) is None:
            raise ValueError("position: expected a frame with a prediction before")
        k = int(np.searchsorted(window.frames.times, time))
        mean, covariance = (values[min(k, len(window.x) - 1)] for values in (window.mean, window.covariance))
        if k == len(window.x):
            (F,), (W,) = moving(self.motion, time - window.frames.times[-1:])
            mean, covariance = F @ mean, F @ covariance @ F.T + np.linalg.inv(W)
        return mean[:3] + window.frames.origin, covariance[:3, :3]

    def _first(self, time: float, views: Views) -> Solved:
        """The window of the first frame."""
        frame = Frames.checked(np.array([time], dtype=float), views)
        self._start = start(self.motion)
        x = np.zeros((1, len(self._start[0])))
        x[0, :3] = frame.about[0]
        frame = sheared(frame, frame.about) if self.slow != NONE else frame
        self._first_seen = frame
        return solve(frame, x, (*self._start, *moving(self.motion, np.empty(0))), self.slow)

    def _next(self, window: Solved, time: float, views: Views | None) -> Solved:
        """The window with one more frame, without its first one if it is full."""
        drop = int(len(window.x) > self.lag)
        F, W = moving(self.motion, time - window.frames.times[-1:])
        x = np.concatenate([window.x[drop:], F @ window.unknowns[-1]])
        frames = window.frames.followed_by(time, views, x[-1:, :3], drop)
        if self.slow != NONE:
            frames = sheared(frames, x[-1:, :3], self._first_seen)
        F, W = np.concatenate([window.chain.F, F]), np.concatenate([window.chain.W, W])
        if drop:
            self._start = after_first(window, F[0], W[0])
        return solve(frames, x, (*self._start, F[drop:], W[drop:]), self.slow)

    def _state(self, k: int) -> State:
        """That of a frame of the window."""
        assert self._window is not None
        window, v = self._window, VELOCITY
        mean, covariance, origin = window.mean[k], window.covariance[k], window.frames.origin
        numbers = (
            window.unknowns[k, :3] + origin, window.unknowns[k, v], mean[:3] + origin,
            covariance[:3, :3], covariance[v, v], window.excess[k], window.frames.a[k], window.frames.own[k],
        )  # fmt: skip
        return State(float(window.frames.times[k]), *(torch.from_numpy(value.copy()) for value in numbers))


def after_first(
    window: Solved, F: Float[Array, "d d"], W: Float[Array, "d d"]
) -> tuple[Float[Array, " d"], Float[Array, "d d"]]:
    """Mean and precision of the second frame's unknowns given the first frame, by its Gaussian factors.

    F and W are those between the two.
    """
    chain, factors = window.chain, window.moments.factors[0]
    slope, K = chain.slope[0], np.zeros((len(factors), 3, 3))
    K[:, (0, 0, 1, 1, 2), (0, 1, 0, 1, 2)] = factors[:, (0, 1, 1, 2, 3)]
    precision, pull = chain.precision.copy(), chain.precision @ chain.mean
    across = slope.swapaxes(-1, -2)
    precision[:3, :3] += (across @ K @ slope).sum(0)
    pull[:3] += (across @ (factors[:, 4:, None] - K @ chain.at_origin[0, :, :, None])).sum(0)[:, 0]
    covariance = np.linalg.inv(precision)
    moved = F @ covariance @ F.T + np.linalg.inv(W)
    return F @ covariance @ pull, np.linalg.inv((moved + moved.T) / 2)

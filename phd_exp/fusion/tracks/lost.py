"""When a track ends: no prediction for too long, or too many frames that contradict the path."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from phd_exp.fusion.tracks.solved import Solved


@dataclass(frozen=True)
class Lost:
    """When a track ends.

    Args:
        after: seconds without a prediction.
        contradictions: this many frames with predictions, one after the other, that contradict the path.
        probability: a view contradicts the path if it gives less than this probability to all positions that are
            no more likely; a frame does if at least half of its views do.

    Raises:
        ValueError: a number is out of range.
    """

    after: float = 1.0
    contradictions: int = 5
    probability: float = 1e-4

    def __post_init__(self) -> None:
        if not self.after > 0:
            raise ValueError(f"after: got {self.after}; expected a positive number of seconds")
        if self.contradictions < 1:
            raise ValueError(f"contradictions: got {self.contradictions}; expected a number of frames, at least 1")
        if not 0 <= self.probability < 1:
            raise ValueError(f"probability: got {self.probability}; expected a probability from 0 to less than 1")

    @property
    def least_excess(self) -> float:
        """An excess energy, nats, that a view must have to contradict the path: its level is at most 1 - e^(-W)/2."""
        return -math.log(2 * self.probability) if self.probability else math.inf

    def contradicts(self, surprise: Float[np.ndarray, "frames cameras"]) -> Bool[np.ndarray, " frames"]:
        """Which frames contradict the path; `surprise` is NaN where a camera takes no part."""
        against = (surprise > 1 - self.probability).sum(-1)
        views = (~np.isnan(surprise)).sum(-1)
        return (views > 0) & (2 * against >= views)

    def gap(self, times: Float[np.ndarray, " frames"], seen: Bool[np.ndarray, " frames"]) -> tuple[int, str | None]:
        """The number of frames up to the first gap that is too long, and the reason of the end if there is one.

        Frames without a prediction belong to the track for as long as `after`.
        """
        last = np.maximum.accumulate(np.where(seen, times, -math.inf))
        late = times - np.concatenate([last[:1], last[:-1]]) > self.after
        if not late.any():
            return len(times), None
        k = int(np.argmax(late))
        return k, self.late(last[k - 1])

    def late(self, last: float) -> str:
        """The reason of an end by a gap after the last prediction."""
        return f"lost after {last:g} s: no prediction for more than {self.after:g} s"

    def contradicted(self, solved: Solved, begun: bool = False) -> tuple[int, str | None]:
        """The number of frames before the first run of contradictions that is too long, and the reason.

        Unless the track has `begun` before, a run from the first frame on does not end it: then it is the later
        frames that agree.
        """
        times = solved.frames.times
        if not (solved.excess > self.least_excess).any():  # levels take a third of the time of a track
            return len(times), None
        surprise = solved.surprise
        against, seen = self.contradicts(surprise), (~np.isnan(surprise)).any(-1)
        run, begin = 0, 0
        for k in seen.nonzero()[0]:
            begin = begin if run and against[k] else int(k)
            run = run + 1 if against[k] else 0
            if run == self.contradictions and (begun or begin > 0):
                return begin, f"lost at {times[begin]:g} s: from then on {run} frames in a row contradict the path"
        return len(times), None


USUAL = Lost()

"""Errors that consecutive frames share: a slow factor of depth, and a slow offset of the projection.

Both are Ornstein-Uhlenbeck processes of variance 1, whose correlation over a time s is exp(-s/time). A share of the
variance of each prediction belongs to them, the rest to the frame alone.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import optimize
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.huber import HUBER_COVARIANCE
from phd_exp.fusion.pose import Pose
from phd_exp.fusion.shared import own_part
from phd_exp.fusion.tracks.frames import Frames, Gaussian


@dataclass(frozen=True)
class Slow:
    """How much of the predictions' errors is slow.

    Args:
        depth_share: part of the variance of log depth that all cameras share and that changes slowly, from 0 to less
            than 1.
        depth_time: its time constant, seconds.
        projection_share: part of the variance of (x, y)/z that changes slowly, on its own in each camera.
        projection_time: its time constant, seconds.

    Raises:
        ValueError: a number is out of range.
    """

    depth_share: float = 0.0
    depth_time: float = 1.0
    projection_share: float = 0.0
    projection_time: float = 1.0

    def __post_init__(self) -> None:
        for name in ("depth_share", "projection_share"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name}: got {getattr(self, name)}; expected a share from 0 to less than 1")
        for name in ("depth_time", "projection_time"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name}: got {getattr(self, name)}; expected a positive number of seconds")

    def times(self, cameras: int) -> list[float]:
        """The time constant of each slow unknown: the factor of depth, then the offsets camera by camera."""
        offsets = [self.projection_time] * (2 * cameras if self.projection_share else 0)
        return [self.depth_time] * bool(self.depth_share) + offsets

    def frames(
        self,
        times: Float[Tensor, " frames"],
        predictions: ProjectedHuber | Gaussian,
        pose: Pose,
        mask: Bool[Tensor, "frames cameras"] | None,
    ) -> Frames:
        """The frames without the slow errors.

        Raises:
            ValueError: an argument of `track` is not valid.
        """
        none = self.depth_share == self.projection_share == 0
        if not none and isinstance(predictions, Gaussian):
            raise ValueError("slow: got Gaussian predictions; expected ProjectedHuber")
        if none or not isinstance(predictions, ProjectedHuber):
            return Frames.checked(times, predictions, pose, mask)
        own, deviation = predictions, torch.zeros(predictions.batch_shape)
        if self.depth_share:
            own, deviation = own_part(predictions, torch.tensor(self.depth_share, dtype=torch.float64))
        own = own.tempered(math.sqrt(1 - self.projection_share), 1.0)
        frames = Frames.checked(times, own, pose, mask)
        return replace(frames, deviation=np.where(frames.mask, deviation.double().numpy(), 0.0))

    @property
    def offset(self) -> float:
        """Standard deviation of the slow offset in units of a frame's own q."""
        return math.sqrt(HUBER_COVARIANCE * self.projection_share / (1 - self.projection_share))


def standardised_errors(
    predictions: ProjectedHuber, truth: Float[Tensor, "*batch 3"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 2"]]:
    """Errors of depth and of (x, y)/z at true positions (camera frame, metres), over their standard deviations."""
    depth = (truth[..., 2] - predictions.depth_mean) / predictions.depth_variance.sqrt()
    offset = truth[..., :2] / truth[..., 2:] - predictions.mu_xy
    return depth, (predictions.A @ offset[..., None]).squeeze(-1) / math.sqrt(HUBER_COVARIANCE)


def autocorrelation(
    times: Sequence[Float[np.ndarray, " frames"]], errors: Sequence[Float[np.ndarray, " frames"]]
) -> tuple[float, float]:
    """Share and time constant (seconds) of the slow part of errors: what `Slow` takes.

    Products of two errors of a sequence, over the mean square, have the expectation share exp(-s/time) at a distance
    of s seconds. Both numbers are fitted to all pairs by least squares.

    Args:
        times: of the frames of each sequence, seconds.
        errors: `standardised_errors` of one coordinate in each sequence.

    Raises:
        ValueError: no sequence has two frames.
    """
    pairs = [np.triu_indices(len(sequence), 1) for sequence in times]
    if not any(len(i) for i, _ in pairs):
        raise ValueError(
            f"times: got {len(times)} sequences of one frame at most; expected two frames in one of them"
        )
    lag = np.concatenate([abs(s[j] - s[i]) for s, (i, j) in zip(times, pairs, strict=True)])
    product = np.concatenate([e[i] * e[j] for e, (i, j) in zip(errors, pairs, strict=True)])
    product = product / np.mean(np.concatenate(list(errors)) ** 2)

    def share(log_time: float) -> tuple[float, float]:
        """The best share in [0, 1) for a time constant, and the sum of squares."""
        decay = np.exp(-lag / np.exp(log_time))
        best = min(max(float(product @ decay / max(decay @ decay, 1e-300)), 0.0), 0.999)
        return best, float(((product - best * decay) ** 2).sum())

    step = float(np.median(lag))
    bounds = (math.log(float(lag.min()) * 0.3), math.log(step * 1e3))
    found = optimize.minimize_scalar(lambda log_time: share(log_time)[1], bounds=bounds, method="bounded")
    return share(found.x)[0], math.exp(found.x)


NONE = Slow()

"""Errors that consecutive frames share: the weight of a frame is the information that its neighbours lack.

Let the standardised errors of a camera be an Ornstein-Uhlenbeck process, whose correlation over s seconds is
exp(-s/time). Of the frames of an object at rest, the best mean has the weights of the rows of the inverse correlation
matrix. With decay = exp(-s/time) over the steps to the frames before and after, that of a frame is

    1 - decay_before/(1 + decay_before) - decay_after/(1 + decay_after),

and the sum over the frames of a duration T is about 1 + T/(2 time). A path multiplies densities to the power of these
weights. They are positive, so nothing is extrapolated and the energy of the path stays convex.

Source: own derivation. The product of powers of densities is a logarithmic opinion pool (Genest and Zidek, "Combining
probability distributions", 1986).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import optimize
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.huber import HUBER_COVARIANCE


@dataclass(frozen=True)
class Slow:
    """Correlation times of the errors of a camera's predictions.

    Args:
        depth_time: time constant of the errors of log depth, seconds; 0 for independent frames.
        projection_time: that of (x, y)/z.

    Raises:
        ValueError: a number is negative or not finite.
    """

    depth_time: float = 0.0
    projection_time: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 <= value < math.inf:
                raise ValueError(f"{name}: got {value}; expected a number of seconds, 0 for independent frames")


NONE = Slow()


def weights(
    time: float, since: Float[np.ndarray, "frames cameras"], mask: Bool[np.ndarray, "frames cameras"]
) -> Float[np.ndarray, "frames cameras"]:
    """The weight of each frame, given the seconds `since` the camera's prediction before; 0 where masked out."""
    found = mask.astype(float)
    for camera in range(mask.shape[1] if time else 0):
        seen = mask[:, camera]
        decay = np.exp(-since[seen, camera] / time)
        shared = decay / (1 + decay)
        found[seen, camera] -= shared + np.append(shared[1:], 0.0)
    return found


def standardised_errors(
    predictions: ProjectedHuber, truth: Float[Tensor, "*batch 3"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 2"]]:
    """Errors of depth and of (x, y)/z at true positions (camera frame, metres), over their standard deviations."""
    depth = (truth[..., 2] - predictions.depth_mean) / predictions.depth_variance.sqrt()
    offset = truth[..., :2] / truth[..., 2:] - predictions.mu_xy
    return depth, (predictions.A @ offset[..., None]).squeeze(-1) / math.sqrt(HUBER_COVARIANCE)


def correlation_time(
    times: Sequence[Float[np.ndarray, " frames"]], errors: Sequence[Float[np.ndarray, " frames"]]
) -> float:
    """The time constant of errors, seconds, of which `Slow` takes two.

    Products of two errors of a sequence, over the mean square, have the expectation exp(-s/time) at a distance of s
    seconds. The time is fitted to all pairs by least squares.

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

    def loss(log_time: float) -> float:
        return float(np.square(product - np.exp(-lag / math.exp(log_time))).sum())

    bounds = math.log(0.1 * float(lag.min())), math.log(1000 * float(np.median(lag)))
    return math.exp(optimize.minimize_scalar(loss, bounds=bounds, method="bounded").x)

"""The frames of a path: checked, and written as affine functions of the object's position."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from phd_exp.distributions.density import Density
from phd_exp.fusion.views import GAUSSIAN, Status, Views, own_width


@dataclass(frozen=True)
class Gaussian:
    """Predictions given by their moments in the camera frame, as those of densities without closed forms.

    (q_x, q_y, t) are the deviations from the mean, divided by the Cholesky factor of the covariance.

    Args:
        mean: expected position, metres.
        covariance: square metres, positive definite.
    """

    mean: Float[Tensor, "*batch 3"]
    covariance: Float[Tensor, "*batch 3 3"]

    @classmethod
    def of(cls, density: Density) -> "Gaussian":
        """With the moments of any density that has a covariance."""
        return cls(density.mean, density.covariance_matrix)

    @property
    def batch_shape(self) -> torch.Size:
        """Shape of the batch."""
        return self.mean.shape[:-1]

    @property
    def measure(self) -> Float[Tensor, "*batch 3 3"]:
        """The matrix from deviations (metres) to (q, t); NaN where the covariance is not positive definite."""
        covariance = self.covariance.double()
        L, failed = torch.linalg.cholesky_ex(covariance.nan_to_num())
        valid = (failed == 0) & covariance.isfinite().all(-1).all(-1)
        return torch.linalg.inv_ex(L)[0].masked_fill(~valid[..., None, None], torch.nan)

    @property
    def apex(self) -> Float[Tensor, "*batch 3"]:
        """Where q and t are 0: the mean, metres."""
        return self.mean

    @property
    def mode(self) -> Float[Tensor, "*batch 3"]:
        """The mean, metres."""
        return self.mean

    @property
    def a(self) -> Float[Tensor, "*batch"]:
        """GAUSSIAN."""
        return torch.full_like(self.mean[..., 0], GAUSSIAN)

    @property
    def rounding(self) -> float:
        """0, since a Gaussian has no kink."""
        return 0.0


@dataclass(frozen=True)
class Frames:
    """What every camera measures in every frame; in float64, relative to a common origin.

    Args:
        times: seconds.
        origin: of the coordinates below, in the world, metres.
        slope: d(q_x, q_y, t)/dv, 1/metres; 0 where a camera takes no part.
        at_origin: (q_x, q_y, t) at the origin.
        a: precision of the depth, or GAUSSIAN; 0 where a camera takes no part.
        own: the width of a rounded mode of t; 0 for a kink.
        since: seconds since the camera's prediction before; inf without one.
        centres: the positions of the cameras; 0 where a camera takes no part.
        apices: apices of the densities, which without a free axis are the positions of the cameras; 0 as above.
        about: a path, see `phd_exp.fusion.tracks.shear`; at first the average of each frame's predicted positions,
            interpolated in frames without a prediction.
        shear: S and offset there; at first I and 0.
    """

    times: Float[np.ndarray, " frames"]
    origin: Float[np.ndarray, "3"]
    slope: Float[np.ndarray, "frames cameras 3 3"]
    at_origin: Float[np.ndarray, "frames cameras 3"]
    a: Float[np.ndarray, "frames cameras"]
    own: Float[np.ndarray, "frames cameras"]
    since: Float[np.ndarray, "frames cameras"]
    centres: Float[np.ndarray, "frames cameras 3"]
    apices: Float[np.ndarray, "frames cameras 3"]
    about: Float[np.ndarray, "frames 3"]
    shear: Float[np.ndarray, "frames 3 4"]

    @classmethod
    def checked(cls, times: Float[np.ndarray, " frames"], views: Views) -> "Frames":
        """The frames at these times, seconds.

        Raises:
            ValueError: an argument is not valid; one line.
        """
        _require_valid(times, views)
        seen = views.mask.any(-1)
        if not seen.any():
            raise ValueError("mask: got no prediction in any frame; expected at least one")
        middle = views.middle
        origin = middle[seen].mean(0)
        about = np.stack([np.interp(times, times[seen], axis) for axis in (middle[seen] - origin).T], -1)
        latest = np.maximum.accumulate(np.where(views.mask, times[:, None], -np.inf))
        since = times[:, None] - np.concatenate([np.full_like(latest[:1], -np.inf), latest[:-1]])
        own = own_width(views.a, views.predictions)
        of_views = views.slope, views.at(origin), views.a, own, since
        return cls(
            times, origin, *of_views, *_places(views, origin), about, np.tile(np.eye(3, 4), (len(times), 1, 1))
        )

    @property
    def mask(self) -> Bool[np.ndarray, "frames cameras"]:
        """Which cameras take part."""
        return self.a != 0

    def __getitem__(self, part: slice) -> "Frames":
        """Some of the frames."""
        values = {name: value if name == "origin" else value[part] for name, value in vars(self).items()}
        return Frames(**values)

    def followed_by(
        self, time: float, views: Views | None, about: Float[np.ndarray, "1 3"], drop: int = 0
    ) -> "Frames":
        """Without the first `drop` frames, and with one more, about a position; without `views`, it has no camera.

        Raises ValueError as `checked`.
        """
        times = np.array([time], dtype=float)
        latest = self.times[-1] - np.where(self.mask[-1], 0.0, self.since[-1])
        further = {"times": times, "since": time - latest[None], "about": about, "shear": np.eye(3, 4)[None]}
        if views is None:
            masked = "slope", "at_origin", "a", "own", "centres", "apices"
            further |= {name: np.zeros_like(getattr(self, name)[-1:]) for name in masked}
            further["at_origin"][..., 2] = 1.0
        else:
            _require_valid(times, views)
            further |= {"slope": views.slope, "at_origin": views.at(self.origin), "a": views.a}
            centres, apices = _places(views, self.origin)
            further |= {"own": own_width(views.a, views.predictions), "centres": centres, "apices": apices}
        joined = {name: np.concatenate([getattr(self, name)[drop:], value]) for name, value in further.items()}
        return Frames(origin=self.origin, **joined)


def _places(
    views: Views, origin: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "frames cameras 3"], Float[np.ndarray, "frames cameras 3"]]:
    """Cameras and apices relative to the origin; 0 where masked out."""
    mask = views.mask[..., None]
    return np.where(mask, views.cameras - origin, 0.0), np.where(mask, views.apex - origin, 0.0)


def _require_valid(times: Float[np.ndarray, " times"], views: Views) -> None:
    """Raise ValueError unless the times are one increasing number for each frame, and all views are valid."""
    frames = len(views.a)
    if times.shape != (frames,):
        raise ValueError(f"times: got shape {times.shape}; expected ({frames},), one time for each frame")
    if not np.isfinite(times).all():
        k = int(np.argmin(np.isfinite(times)))
        raise ValueError(f"times: got {times[k]} in frame {k}; expected finite times in seconds")
    for k in (np.diff(times) <= 0).nonzero()[0]:
        raise ValueError(
            f"times: got {times[k + 1]} in frame {k + 1} after {times[k]}; expected increasing times; remove "
            "repeated frames and sort the others"
        )
    for k in (views.status > Status.NO_CAMERA).nonzero()[0]:
        raise ValueError(f"frame {k}: {Status(int(views.status[k])).reason}")

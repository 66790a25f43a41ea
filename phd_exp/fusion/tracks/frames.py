"""The frames of a path: checked, and written as affine functions of the object's position."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.density import Density
from phd_exp.fusion.gaussian import average
from phd_exp.fusion.pose import Pose
from phd_exp.fusion.problems import Problems, Status, flat, own_width, status_of
from phd_exp.fusion.tracks.energy import GAUSSIAN


@dataclass(frozen=True)
class Gaussian:
    """Predictions given by their moments in the camera frame, as those of densities without closed forms.

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


@dataclass(frozen=True)
class Frames:
    """What every camera measures in every frame; in float64, relative to a common origin.

    Args:
        times: seconds.
        origin: of the coordinates below, in the world, metres.
        slope: d(q_x, q_y, t)/dv, 1/metres; 0 where a camera takes no part.
        at_origin: (q_x, q_y, t) at the origin.
        a: precision of the depth, or GAUSSIAN; 0 where a camera takes no part.
        own: the width of a rounded mode of t.
        mask: which cameras take part.
        near: the average of each frame's predicted positions; those of the nearest frames where there is none.
        since: seconds since the camera's prediction before; inf without one.
        centres: the apices of the densities, without a free axis the positions of the cameras.
        about: a path, see `phd_exp.fusion.tracks.shear`; at first `near`.
        shear: S and offset there; at first I and 0.
    """

    times: Float[np.ndarray, " frames"]
    origin: Float[np.ndarray, "3"]
    slope: Float[np.ndarray, "frames cameras 3 3"]
    at_origin: Float[np.ndarray, "frames cameras 3"]
    a: Float[np.ndarray, "frames cameras"]
    own: Float[np.ndarray, "frames cameras"]
    mask: Bool[np.ndarray, "frames cameras"]
    near: Float[np.ndarray, "frames 3"]
    since: Float[np.ndarray, "frames cameras"]
    centres: Float[np.ndarray, "frames cameras 3"]
    about: Float[np.ndarray, "frames 3"]
    shear: Float[np.ndarray, "frames 3 4"]

    @classmethod
    def checked(
        cls,
        times: Float[Tensor, " frames"],
        predictions: ProjectedHuber | Gaussian,
        pose: Pose,
        mask: Bool[Tensor, "frames cameras"] | None,
    ) -> "Frames":
        """The frames of the arguments of `track`.

        Raises:
            ValueError: an argument is not valid; one line.
        """
        if not isinstance(predictions, ProjectedHuber | Gaussian):
            raise ValueError(
                f"predictions: got {type(predictions).__name__}; expected ProjectedHuber or Gaussian; use "
                "Gaussian.of for other densities; a point estimate has no uncertainty"
            )
        shape = predictions.batch_shape
        if len(shape) != 2 or 0 in shape:
            raise ValueError(
                f"predictions: got batch shape {tuple(shape)}; expected (frames, cameras), none of them 0"
            )
        seconds = checked_times(times, shape[0])
        views = _views(predictions, pose, mask)
        for k, status in enumerate(views.status.tolist()):
            if status not in (Status.FUSED, Status.NO_CAMERA):
                raise ValueError(f"frame {k}: {Status(status).reason}")
        seen = views.mask.any(-1).numpy()
        if not seen.any():
            raise ValueError("mask: got no prediction in any frame; expected at least one")
        position = views.position.numpy()
        origin = position[seen].mean(0)
        near = np.stack([np.interp(seconds, seconds[seen], axis) for axis in (position[seen] - origin).T], -1)
        at_origin = views.at_zero.numpy() + (views.slope.numpy() @ origin)
        shown = views.mask.numpy()
        at_origin = np.where(shown[..., None], at_origin, (0.0, 0.0, 1.0))
        latest = np.maximum.accumulate(np.where(shown, seconds[:, None], -np.inf))
        since = seconds[:, None] - np.concatenate([np.full_like(latest[:1], -np.inf), latest[:-1]])
        slope = np.ascontiguousarray(views.slope.numpy())
        centres = np.where(shown[..., None], views.centres.numpy() - origin, 0.0)
        of_cameras = slope, at_origin, views.a.numpy(), views.own.numpy(), shown
        shear = np.tile(np.eye(3, 4), (len(seconds), 1, 1))
        return cls(seconds, origin, *of_cameras, near, since, centres, near, shear)

    def __getitem__(self, part: slice) -> "Frames":
        """Some of the frames."""
        values = {name: value if name == "origin" else value[part] for name, value in vars(self).items()}
        return Frames(**values)

    def unseen(self, time: float) -> "Frames":
        """One later frame, in which no camera takes part."""
        masked = "slope", "at_origin", "a", "own", "mask"
        nothing = {name: np.zeros_like(getattr(self, name)[-1:]) for name in masked}
        nothing["at_origin"][..., 2] = 1.0
        return replace(self[-1:], times=np.array([time]), **nothing)

    def followed_by(self, later: "Frames") -> "Frames":
        """With one frame more, relative to the same origin."""
        shift = self.origin - later.origin
        at_origin = later.at_origin + later.slope @ shift
        latest = self.times[-1] - np.where(self.mask[-1], 0.0, self.since[-1])
        moved = {name: getattr(later, name) - shift for name in ("near", "centres", "about")}
        later = replace(later, at_origin=at_origin, since=later.times[:, None] - latest, **moved)
        values = {name: np.concatenate([value, getattr(later, name)]) for name, value in vars(self).items()}
        return Frames(**(values | {"origin": self.origin}))


def checked_times(times: Float[Tensor, " frames"], frames: int) -> Float[np.ndarray, " frames"]:
    """The times in float64. Raises ValueError where they are not one increasing number for each frame."""
    if tuple(times.shape) != (frames,):
        raise ValueError(f"times: got shape {tuple(times.shape)}; expected ({frames},), one time for each frame")
    seconds = times.double().cpu().numpy()
    if not np.isfinite(seconds).all():
        k = int(np.argmin(np.isfinite(seconds)))
        raise ValueError(f"times: got {seconds[k]} in frame {k}; expected finite times in seconds")
    for k in (np.diff(seconds) <= 0).nonzero()[0]:
        raise ValueError(
            f"times: got {seconds[k + 1]} in frame {k + 1} after {seconds[k]}; expected increasing times; remove "
            "repeated frames and sort the others"
        )
    return seconds


@dataclass(frozen=True)
class _Views:
    """The views of all frames in the world: as in `Frames`, but `at_zero` is at the world's origin.

    `position` is the average of each frame's predicted positions; NaN where no camera takes part.
    """

    slope: Float[Tensor, "frames cameras 3 3"]
    at_zero: Float[Tensor, "frames cameras 3"]
    a: Float[Tensor, "frames cameras"]
    own: Float[Tensor, "frames cameras"]
    mask: Bool[Tensor, "frames cameras"]
    position: Float[Tensor, "frames 3"]
    centres: Float[Tensor, "frames cameras 3"]
    status: Int[Tensor, " frames"]


def _views(predictions: ProjectedHuber | Gaussian, pose: Pose, mask: Tensor | None) -> _Views:
    if isinstance(predictions, Gaussian):
        return _gaussian_views(predictions, pose, mask)
    problems = Problems.posed(predictions, pose, None, mask)
    origin = problems.origin.nan_to_num()[:, None, :, None]
    at_zero = problems.at_origin - (problems.slope @ origin).squeeze(-1)
    centres = problems.pose.into_world(predictions.apex.double().cpu())
    own = own_width(problems.a, predictions)
    return _Views(problems.slope, at_zero, problems.a, own, problems.mask, problems.origin, centres, problems.status)


def _gaussian_views(predictions: Gaussian, pose: Pose, mask: Tensor | None) -> _Views:
    """q_x, q_y and t are the deviations from the mean, divided by the Cholesky factor of the covariance."""
    shape = predictions.batch_shape
    pose = Pose(flat("pose.R", pose.R, shape, event=2), flat("pose.t", pose.t, shape, event=1))
    mask = flat("mask", torch.ones(shape) if mask is None else mask, shape) > 0
    mean = flat("predictions", predictions.mean, shape, event=1)
    L, failed = torch.linalg.cholesky_ex(flat("predictions", predictions.covariance, shape, event=2).nan_to_num())
    whiten = torch.linalg.inv_ex(L)[0]
    slope = torch.where(mask[..., None, None], whiten @ pose.R, 0)
    at_zero = torch.where(mask[..., None], (whiten @ (pose.t - mean)[..., None]).squeeze(-1), 0)
    valid = (failed == 0) & predictions.covariance.isfinite().all(-1).all(-1).cpu() & mean.isfinite().all(-1)
    status = status_of(mask, valid, pose.is_rigid, None)
    centres = pose.into_world(torch.zeros(3, dtype=torch.float64))
    a = torch.where(mask, GAUSSIAN, 0.0).double()
    return _Views(slope, at_zero, a, torch.zeros_like(a), mask, average(pose.into_world(mean), mask), centres, status)

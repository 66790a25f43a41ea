"""A batch of fusion problems: checked, flattened, and written as affine functions of the unknowns."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from phd_exp.distributions import ProjectedHuber
from phd_exp.fusion.gaussian import average
from phd_exp.fusion.pose import Plane, Pose


class Status(IntEnum):
    """How a problem ended, with the `reason` in one line; all but FUSED are failures, with NaN instead of numbers."""

    reason: str

    FUSED = 0, "fused"
    NO_CAMERA = 1, "all cameras are masked out; expected at least one"
    NOT_FINITE = 2, "a prediction, pose or plane is not finite; mask out that camera or correct its numbers"
    NOT_A_ROTATION = 3, "the R of a pose is not a rotation to 1e-6; expected R R^T = I and |R| = 1"
    NOT_A_PLANE = 4, "the normal of the plane is zero; expected a direction"
    NO_COMMON_VIEW = (5, "no position is in front of every camera; check that poses map world to camera, R v + t")
    PLANE_BEHIND_CAMERA = 6, "no point of the plane is in front of every camera; check its normal and offset"
    CONTRADICTION = (
        7,
        "at least half of the views rule out every common position; check the poses, the plane, and that all "
        "cameras see the same object",
    )
    NOT_CONVERGED = 8, "the optimum was not found to machine precision; check whether the numbers are extreme"

    def __new__(cls, code: int, reason: str = "") -> "Status":
        status = int.__new__(cls, code)
        status._value_, status.reason = code, reason
        return status


@dataclass(frozen=True)
class Problems:
    """The (q_x, q_y, t) of every camera as an affine function of the unknowns u; in float64, on the CPU.

    A masked camera has q = 0 and t = 1 at every position, and a = 0: it adds a constant to the energy.

    Args:
        predictions: as given to `fuse`.
        pose: as given to `fuse`.
        mask: as given to `fuse`.
        origin: the world position of u = 0, where the search starts, metres: the average of the predicted positions,
            or the nearest point of the plane.
        directions: the world position is origin + directions u; on a plane the third column is zero.
        dimensions: the number of unknowns, 3, or 2 on a plane.
        slope: d(q_x, q_y, t)/du, 1/metres.
        free_slope: the same with respect to the world position.
        at_origin: (q_x, q_y, t) at u = 0.
        a: precision of the depth.
        status: FUSED where the input is valid.
    """

    predictions: ProjectedHuber
    pose: Pose
    mask: Bool[Tensor, "problems cameras"]
    origin: Float[Tensor, "problems 3"]
    directions: Float[Tensor, "problems 3 3"]
    dimensions: int
    slope: Float[Tensor, "problems cameras 3 3"]
    free_slope: Float[Tensor, "problems cameras 3 3"]
    at_origin: Float[Tensor, "problems cameras 3"]
    a: Float[Tensor, "problems cameras"]
    status: Int[Tensor, " problems"]

    @classmethod
    def posed(
        cls,
        predictions: ProjectedHuber,
        pose: Pose,
        plane: Plane | None,
        mask: Bool[Tensor, "*problems cameras"] | None,
    ) -> "Problems":
        """The problems of the arguments of `fuse`. Raises ValueError where shapes do not broadcast."""
        shape = predictions.batch_shape
        if len(shape) == 0 or shape[-1] == 0:
            raise ValueError(f"predictions: got batch shape {tuple(shape)}; expected (*problems, cameras)")
        pose = Pose(flat("pose.R", pose.R, shape, event=2), flat("pose.t", pose.t, shape, event=1))
        mask = flat("mask", torch.ones(shape) if mask is None else mask, shape) > 0
        measure = flat("predictions", predictions.measure, shape, event=2)
        mode = flat("predictions", predictions.mode, shape, event=1)
        a = flat("predictions", predictions.a, shape)
        origin = average(pose.into_world(mode), mask)
        directions = torch.eye(3, dtype=torch.float64).expand(len(origin), 3, 3)
        if plane is not None:
            normal = flat("plane.normal", plane.normal, shape[:-1], event=1, cameras=0)
            plane = Plane(normal, flat("plane.offset", plane.offset, shape[:-1], cameras=0))
            origin, directions = plane.nearest(origin), pad(plane.directions, (0, 1))
        apex = flat("predictions", predictions.apex, shape, event=1)
        at_origin = (measure @ (pose.into_camera(origin[:, None]) - apex)[..., None]).squeeze(-1)
        free_slope = measure @ pose.R
        # 0, or NaN where one of the numbers that these are products of is not finite
        finite = 0 * (free_slope.sum((-2, -1)) + at_origin.sum(-1) + a) == 0
        valid = finite & (a > 0) & (mode[..., 2] > 0)
        free_slope = torch.where(mask[..., None, None], free_slope, 0)
        slope, dimensions = (free_slope, 3) if plane is None else (free_slope @ directions[:, None], 2)
        at_origin = torch.where(mask[..., None], at_origin, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
        a, status = torch.where(mask, a, 0), status_of(mask, valid, pose.is_rigid, plane)
        return cls(predictions, pose, mask, origin, directions, dimensions, slope, free_slope, at_origin, a, status)

    @property
    def views(self) -> list[Float[np.ndarray, "problems ..."]]:
        """Slope, value at the origin, precision and width of a rounded mode, as the compiled functions take them."""
        own = own_width(self.a, self.predictions)
        return [values.numpy() for values in (self.slope, self.at_origin, self.a, own)]

    def in_world(self, u: Float[Tensor, "problems 3"]) -> Float[Tensor, "problems 3"]:
        """origin + directions u."""
        return self.origin + (self.directions @ u[..., None]).squeeze(-1)

    def alone(self) -> tuple[Bool[Tensor, " problems"], Float[Tensor, "alone 3"], Float[Tensor, "alone 3 3"]]:
        """Which problems have one camera and no plane; mean (metres) and covariance of its density, in the world."""
        alone = (self.mask.sum(-1) == 1) & (self.dimensions == 3)
        camera = alone[:, None] & self.mask
        shape = self.predictions.batch_shape
        mean = flat("mean", self.predictions.mean, shape, event=1)[camera]
        covariance = flat("covariance", self.predictions.covariance_matrix, shape, event=2)[camera]
        pose = Pose(self.pose.R[camera], self.pose.t[camera])
        return alone, pose.into_world(mean), pose.R.mT @ covariance @ pose.R


def own_width(a: Float[Tensor, "*views"], predictions: ProjectedHuber) -> Float[Tensor, "*views"]:
    """The width of a rounded mode of t, see `phd_exp.fusion.arithmetic`; 0 for cameras that take no part."""
    return torch.where(a > 0, predictions.rounding / a.clamp_min(torch.finfo(a.dtype).tiny), 0)


def status_of(mask: Tensor, valid: Tensor, rigid: Tensor, plane: Plane | None) -> Int[Tensor, " problems"]:
    """The status of each problem, from three masks over its cameras."""
    status = torch.full(mask.shape[:1], int(Status.FUSED))
    status[(~rigid & mask).any(-1)] = Status.NOT_A_ROTATION
    status[(~valid & mask).any(-1)] = Status.NOT_FINITE
    if plane is not None:
        status[(plane.normal == 0).all(-1)] = Status.NOT_A_PLANE
    status[~mask.any(-1)] = Status.NO_CAMERA
    return status


def flat(name: str, value: Tensor, shape: torch.Size, event: int = 0, cameras: int = 1) -> Tensor:
    """The values in one dimension of problems, before those of cameras and event; float64, on the CPU."""
    batch, own = value.shape[: value.ndim - event], value.shape[value.ndim - event :]
    try:
        expanded = value.double().cpu().expand(shape + own)
    except RuntimeError:
        raise ValueError(
            f"{name}: got batch shape {tuple(batch)}; expected one that broadcasts to {tuple(shape)}"
        ) from None
    problems = shape[: len(shape) - cameras].numel()
    return expanded.reshape(problems, *shape[len(shape) - cameras :], *own).contiguous()

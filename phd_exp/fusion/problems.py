"""A batch of fusion problems, in the unknowns that a plane may restrict."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from phd_exp.distributions import ProjectedHuber
from phd_exp.fusion.pose import Plane, Pose
from phd_exp.fusion.views import Status, Views, flat, own_width


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
        views = Views.of(predictions, pose, mask)
        tensors = (views.middle, views.slope, views.a, views.status, views.mask)
        origin, free_slope, a, status, seen = map(torch.from_numpy, tensors)
        slope, directions = free_slope, torch.eye(3, dtype=torch.float64).expand(len(a), 3, 3)
        if plane is not None:
            normal = flat("plane.normal", plane.normal, shape[:-1], event=1, cameras=0)
            offset = flat("plane.offset", plane.offset, shape[:-1], cameras=0)
            plane = Plane(torch.from_numpy(normal), torch.from_numpy(offset))
            origin, directions = plane.nearest(origin), pad(plane.directions, (0, 1))
            slope = free_slope @ directions[:, None]
            status[(status == Status.FUSED) & (plane.normal == 0).all(-1)] = Status.NOT_A_PLANE
        at_origin = torch.from_numpy(views.at(origin.numpy()))
        status[(status == Status.FUSED) & ~at_origin.isfinite().all(-1).all(-1)] = Status.NOT_FINITE
        dimensions = 3 if plane is None else 2
        return cls(predictions, pose, seen, origin, directions, dimensions, slope, free_slope, at_origin, a, status)

    @property
    def views(self) -> list[Float[np.ndarray, "problems ..."]]:
        """Slope, value at the origin, precision and width of a rounded mode, as the compiled functions take them."""
        slope, at_origin, a = (values.numpy() for values in (self.slope, self.at_origin, self.a))
        return [slope, at_origin, a, own_width(a, self.predictions)]

    def in_world(self, u: Float[Tensor, "problems 3"]) -> Float[Tensor, "problems 3"]:
        """origin + directions u."""
        return self.origin + (self.directions @ u[..., None]).squeeze(-1)

    def alone(self) -> tuple[Bool[Tensor, " problems"], Float[Tensor, "alone 3"], Float[Tensor, "alone 3 3"]]:
        """Which problems have one camera and no plane; mean (metres) and covariance of its density, in the world."""
        alone = (self.mask.sum(-1) == 1) & (self.dimensions == 3)
        camera, shape = alone[:, None] & self.mask, self.predictions.batch_shape
        own = (self.predictions.mean, 1), (self.predictions.covariance_matrix, 2), (self.pose.R, 2), (self.pose.t, 1)
        mean, covariance, R, t = (
            torch.from_numpy(flat("predictions", value, shape, event))[camera] for value, event in own
        )
        return alone, Pose(R, t).into_world(mean), R.mT @ covariance @ R

"""A batch of fusion problems as it was posed: checked, and laid out in one dimension."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.fusion.gaussian import average
from phd_exp.fusion.linear import apply, product
from phd_exp.fusion.pose import Plane, Pose
from phd_exp.fusion.status import Status
from phd_exp.fusion.views import Unknown, Views


@dataclass(frozen=True)
class Problems:
    """What is known of each problem, in float64.

    Args:
        to_seen: the matrix from a position in the camera frame to (q_x, q_y, t).
        a: precision of the depth.
        mode: of each prediction, camera frame, metres.
        pose: of the cameras.
        mask: which cameras take part.
        plane: on which the position lies, if any.
        origin: where a search starts, world, metres: the average of the predicted positions, or the point of the
            plane that is nearest to it.
        directions: in which it goes, orthonormal columns.
    """

    to_seen: Float[Tensor, "problems cameras 3 3"]
    a: Float[Tensor, "problems cameras"]
    mode: Float[Tensor, "problems cameras 3"]
    pose: Pose
    mask: Bool[Tensor, "problems cameras"]
    plane: Plane | None
    origin: Float[Tensor, "problems 3"]
    directions: Float[Tensor, "problems 3 k"]

    @classmethod
    def posed(
        cls,
        predictions: ProjectedHuber,
        pose: Pose,
        plane: Plane | None,
        mask: Bool[Tensor, "*problems cameras"] | None,
    ) -> "Problems":
        """The problems of the arguments of `fuse`. Raises ValueError where their shapes do not fit one another."""
        shape = predictions.batch_shape
        if len(shape) == 0 or shape[-1] == 0:
            raise ValueError(
                f"predictions have the batch shape (*problems, cameras), but theirs is {tuple(shape)}"
            )
        everyone = torch.ones(shape, dtype=torch.bool, device=predictions.a.device)
        pose = Pose(
            _flat("pose.R", pose.R.double(), shape, 1, event=2),
            _flat("pose.t", pose.t.double(), shape, 1, event=1),
        )
        mode = _flat("predictions", predictions.mode.double(), shape, 1, event=1)
        mask = _flat("mask", everyone if mask is None else mask, shape, 1)
        plane = plane and _flat_plane(plane, shape[:-1])
        return cls(
            _flat("predictions", _linear_map(predictions), shape, 1, event=2),
            _flat("predictions", predictions.a.double(), shape, 1),
            mode,
            pose,
            mask,
            plane,
            *_frame(average(pose.into_world(mode), mask), plane),
        )

    def subset(self, problems: Int[Tensor, " some"]) -> "Problems":
        """Some of the problems, in order."""
        if len(problems) == len(self.a):
            return self
        return Problems(
            self.to_seen[problems],
            self.a[problems],
            self.mode[problems],
            Pose(self.pose.R[problems], self.pose.t[problems]),
            self.mask[problems],
            self.plane and Plane(self.plane.normal[problems], self.plane.offset[problems]),
            self.origin[problems],
            self.directions[problems],
        )

    def without_plane(self) -> "Problems":
        """The same problems in all of space."""
        frame = _frame(average(self.pose.into_world(self.mode), self.mask), None)
        return Problems(self.to_seen, self.a, self.mode, self.pose, self.mask, None, *frame)

    @property
    def sound(self) -> Bool[Tensor, "problems cameras"]:
        """Whether each camera's numbers are finite, and its precision and depth positive."""
        finite = self.to_seen.isfinite().all(-1).all(-1) & self.mode.isfinite().all(-1) & self.a.isfinite()
        posed = self.pose.R.isfinite().all(-1).all(-1) & self.pose.t.isfinite().all(-1)
        return finite & (self.a > 0) & (self.mode[..., 2] > 0) & posed

    def status(
        self, sound: Bool[Tensor, "problems cameras"], rigid: Bool[Tensor, "problems cameras"]
    ) -> Int[Tensor, " problems"]:
        """What is wrong with each problem before anything is computed; FUSED where nothing is.

        Args:
            sound: see the property of that name.
            rigid: see `Pose.is_rigid`.
        """
        status = torch.full_like(self.mask[:, 0], int(Status.FUSED), dtype=torch.long)
        if self.plane is not None:
            length = self.plane.normal.norm(dim=-1)
            status[length == 0] = Status.NOT_A_PLANE
            status[~(length.isfinite() & self.plane.offset.isfinite())] = Status.NOT_FINITE
        status[(~rigid & self.mask).any(-1)] = Status.NOT_A_ROTATION
        status[(~sound & self.mask).any(-1)] = Status.NOT_FINITE
        status[~self.mask.any(-1)] = Status.NO_CAMERA
        return status

    def views(self) -> Views:
        """What the cameras see of origin + directions u."""
        slope = product(self.to_seen, self.pose.R)
        if self.plane is not None:
            slope = product(slope, self.directions[:, None])
        at_origin = apply(self.to_seen, self.pose.into_camera(self.origin[:, None]))
        nothing = torch.tensor([0.0, 0.0, 1.0], dtype=self.a.dtype, device=self.a.device)
        slope = torch.where(self.mask[..., None, None], slope, 0)
        at_origin = torch.where(self.mask[..., None], at_origin, nothing)
        a = torch.where(self.mask, self.a, 0)
        return Views(
            slope.permute(2, 3, 1, 0).contiguous(), at_origin.permute(2, 1, 0).contiguous(), a.T.contiguous()
        )

    def in_world(self, u: Unknown) -> Float[Tensor, "problems 3"]:
        """origin + directions u."""
        return self.origin + apply(self.directions, u.T)


def _frame(
    middle: Float[Tensor, "problems 3"], plane: Plane | None
) -> tuple[Float[Tensor, "problems 3"], Float[Tensor, "problems 3 k"]]:
    """Where a search starts and in which directions it goes."""
    if plane is not None:
        return plane.nearest(middle), plane.directions
    identity = torch.eye(3, dtype=middle.dtype, device=middle.device)
    return middle, identity.expand(len(middle), 3, 3)


def _linear_map(predictions: ProjectedHuber) -> Float[Tensor, "*batch 3 3"]:
    """The matrix from a position in the camera frame to (q_x, q_y, t)."""
    axes = torch.eye(3, dtype=predictions.a.dtype, device=predictions.a.device)
    q = torch.stack([predictions.whiten(axis) for axis in axes], dim=-1).double()
    t = axes[2].double() / predictions.mu_z.double()[..., None]
    return torch.cat([q, t[..., None, :]], dim=-2)


def _flat_plane(plane: Plane, shape: torch.Size) -> Plane:
    normal = _flat("plane.normal", plane.normal.double(), shape, 0, event=1)
    return Plane(normal, _flat("plane.offset", plane.offset.double(), shape, 0))


def _flat(name: str, value: Tensor, shape: torch.Size, kept: int, event: int = 0) -> Tensor:
    """The value for each problem in one dimension; the last `kept` dimensions of the batch and the event's stay."""
    batch, own = value.shape[: value.ndim - event], value.shape[value.ndim - event :]
    try:
        expanded = value.expand(shape + own)
    except RuntimeError:
        raise ValueError(
            f"{name} has the batch shape {tuple(batch)}, which does not broadcast to {tuple(shape)}"
        ) from None
    return expanded.reshape(shape[: len(shape) - kept].numel(), *shape[len(shape) - kept :], *own)

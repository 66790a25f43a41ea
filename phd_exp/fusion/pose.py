"""The poses of cameras, and a plane, in the world."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from phd_exp.records import scenes

RIGID_WITHIN = 1e-6  # float32 keeps a rotation to 1e-7


@dataclass(frozen=True)
class Pose:
    """The motion from the world into the frame of each camera: v_camera = R v_world + t.

    The `pose` in the metadata of a data set has this convention; its world is the frame of the scene.

    Args:
        R: rotations from the world's axes to the camera's.
        t: the world's origin in the camera frame, metres.
    """

    R: Float[Tensor, "*#batch 3 3"]
    t: Float[Tensor, "*#batch 3"]

    @classmethod
    def from_scene(cls, poses: Sequence[scenes.Pose]) -> "Pose":
        """The poses of a data set's records, one camera each, in float64; the quaternion (w, x, y, z) becomes R."""
        quaternion = np.reshape([pose.rotation for pose in poses], (-1, 4))
        R = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()  # normalises the quaternion
        t = torch.tensor([pose.translation for pose in poses], dtype=torch.float64).reshape(-1, 3)
        return cls(torch.from_numpy(R), t)

    def into_camera(self, v: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch 3"]:
        """World to camera frame, R v + t."""
        return _product(self.R, v) + self.t

    def into_world(self, v: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch 3"]:
        """Camera frame to world, R^T (v - t)."""
        return _product(self.R.mT, v - self.t)


@np.errstate(invalid="ignore")
def is_rotation(R: Float[np.ndarray, "*batch 3 3"]) -> Bool[np.ndarray, "*batch"]:
    """Whether R R^T = I within 1e-6 and |R| > 0; false where R is not finite."""
    error = abs(R @ R.swapaxes(-1, -2) - np.eye(3)).max((-2, -1))
    found: np.ndarray = (error <= RIGID_WITHIN) & (np.linalg.det(R) > 0)
    return found


def _product(A: Float[Tensor, "*#batch 3 3"], b: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch 3"]:
    """A b, in the wider of the two types."""
    dtype = torch.promote_types(A.dtype, b.dtype)
    return (A.to(dtype) @ b.to(dtype)[..., None]).squeeze(-1)


@dataclass(frozen=True)
class Plane:
    """The points of the world with normal . v = offset, one plane for each problem or one for all.

    Args:
        normal: of any length but zero.
        offset: in metres if the normal has unit length.
    """

    normal: Float[Tensor, "*#batch 3"]
    offset: Float[Tensor, "*#batch"]

    def nearest(self, v: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch 3"]:
        """The point of the plane that is nearest to v."""
        excess = ((self.normal * v).sum(-1) - self.offset) / self.normal.square().sum(-1)
        return v - excess[..., None] * self.normal

    @property
    def directions(self) -> Float[Tensor, "*batch 3 2"]:
        """Two orthonormal directions in the plane, as columns."""
        unit = self.normal / self.normal.norm(dim=-1, keepdim=True)
        # the axis that is farthest from the normal, so that the cross product is long
        axis = torch.nn.functional.one_hot(unit.abs().argmin(-1), 3).to(unit.dtype)
        first = torch.linalg.cross(unit, axis)
        first = first / first.norm(dim=-1, keepdim=True)
        return torch.stack([first, torch.linalg.cross(unit, first)], dim=-1)

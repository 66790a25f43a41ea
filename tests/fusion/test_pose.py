"""Poses and planes."""

import pytest
import torch
from scipy.spatial.transform import Rotation

from phd_exp.fusion import Plane, Pose
from phd_exp.records import scenes
from tests.fusion.random_problems import rotations


def test_a_scene_record_becomes_the_motion_it_describes() -> None:
    """Against scipy's rotations."""
    quaternions = Rotation.random(10, random_state=0).as_quat(scalar_first=True)
    records = [
        scenes.Pose(rotation=tuple(quaternion), translation=(1.0, -2.0, i))
        for i, quaternion in enumerate(quaternions.tolist())
    ]
    pose = Pose.from_scene(records)
    expected = Rotation.from_quat(quaternions, scalar_first=True).as_matrix()
    torch.testing.assert_close(pose.R, torch.from_numpy(expected))
    assert pose.t[3].tolist() == [1, -2, 3]
    assert bool(pose.is_rigid.all())


def test_into_the_camera_and_back() -> None:
    generator = torch.Generator().manual_seed(0)
    t, v = torch.randn(2, 6, 3, generator=generator, dtype=torch.float64)
    pose = Pose(rotations(6, generator), t)
    torch.testing.assert_close(pose.into_world(pose.into_camera(v)), v)


@pytest.mark.parametrize(
    ("matrix", "rigid"),
    [
        (torch.eye(3), True),
        (1.001 * torch.eye(3), False),
        (-torch.eye(3), False),
        (torch.full((3, 3), torch.nan), False),
    ],
    ids=["identity", "scaled", "mirrored", "not finite"],
)
def test_only_rotations_are_rigid(matrix: torch.Tensor, rigid: bool) -> None:
    assert bool(Pose(matrix, torch.zeros(3)).is_rigid) is rigid


def test_a_plane_has_a_nearest_point_and_two_directions() -> None:
    generator = torch.Generator().manual_seed(1)
    normal, v = torch.randn(2, 50, 3, generator=generator, dtype=torch.float64)
    plane = Plane(normal, torch.randn(50, generator=generator, dtype=torch.float64))
    nearest, directions = plane.nearest(v), plane.directions
    torch.testing.assert_close((plane.normal * nearest).sum(-1), plane.offset)
    torch.testing.assert_close(directions.mT @ directions, torch.eye(2, dtype=torch.float64).expand(50, 2, 2))
    zero = torch.zeros(50, 2, dtype=torch.float64)
    torch.testing.assert_close((directions.mT @ normal[..., None]).squeeze(-1), zero)
    torch.testing.assert_close((directions.mT @ (v - nearest)[..., None]).squeeze(-1), zero)

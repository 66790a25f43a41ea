"""Poses and planes."""

import numpy as np
import pytest
import torch

from phd_exp.fusion import Plane, Pose
from phd_exp.fusion.pose import is_rotation
from phd_exp.records import scenes
from tests.support.random_problems import rotations


def test_a_scene_record_becomes_the_motion_it_describes() -> None:
    """v -> q v q* + t with the product of quaternions; records need not keep unit length."""

    def product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        return np.array([p[0] * q[0] - p[1:] @ q[1:], *(p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:]))])

    draw = np.random.default_rng(0)
    quaternions = draw.standard_normal((10, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    t, v = draw.standard_normal((2, 10, 3))
    pairs = zip((quaternions * (1 + 1e-7)).tolist(), t.tolist(), strict=True)
    pose = Pose.from_scene([scenes.Pose(rotation=tuple(q), translation=tuple(t)) for q, t in pairs])
    turned = [
        product(product(q, np.array([0, *x])), q * [1, -1, -1, -1])[1:] for q, x in zip(quaternions, v, strict=True)
    ]
    np.testing.assert_allclose(pose.into_camera(torch.from_numpy(v)), turned + t, rtol=1e-12, atol=1e-12)
    assert is_rotation(pose.R.numpy()).all()


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
    assert is_rotation(matrix[None].numpy()).tolist() == [rigid]


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

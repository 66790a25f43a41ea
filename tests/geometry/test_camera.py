"""The pinhole camera: known pixels, inverses, resizing, and what it refuses."""

import pytest
import torch

from phd_exp.geometry import Camera

CAMERA = Camera(torch.tensor([1200.0, 1500.0, 2000.0], dtype=torch.float64), 224.0)
XYZ = torch.tensor([[0.1, -0.2, 3.0], [-0.3, 0.25, 4.0], [0.0, 0.0, 5.0]], dtype=torch.float64)


def camera(f: float, S: float = 224.0) -> Camera:
    return Camera(torch.tensor(f, dtype=torch.float64), S)


@pytest.mark.parametrize(
    ("xyz", "pixel"),
    [
        ((0.0, 0.0, 4.0), (112.0, 112.0)),
        ((0.28, 0.0, 4.0), (217.0, 112.0)),  # 1500 * 0.28 / 4 = 105 pixels to the right
        ((0.0, 0.28, 4.0), (112.0, 217.0)),  # y points down, as rows do
        ((-0.5, -0.5, 6.6964285714285714), (0.0, 0.0)),  # the top left corner
    ],
)
def test_known_pixels(xyz: tuple[float, ...], pixel: tuple[float, ...]) -> None:
    projected = camera(1500.0).project(torch.tensor(xyz, dtype=torch.float64))
    torch.testing.assert_close(projected, torch.tensor(pixel, dtype=torch.float64))


def test_unproject_inverts_project() -> None:
    torch.testing.assert_close(CAMERA.unproject(CAMERA.project(XYZ), XYZ[:, 2]), XYZ)


@pytest.mark.parametrize(
    ("xyz", "inside"),
    [
        ((0.0, 0.0, 4.0), True),
        ((0.298, -0.298, 4.0), True),  # 111.75 pixels from the middle
        ((0.2987, 0.0, 4.0), False),  # 112.01
        ((0.0, -0.2987, 4.0), False),
        ((0.0, 0.0, 0.0), False),
        ((0.0, 0.0, -4.0), False),
        ((0.1, 0.1, -4.0), False),
    ],
)
def test_contains(xyz: tuple[float, ...], inside: bool) -> None:
    assert bool(camera(1500.0).contains(torch.tensor(xyz, dtype=torch.float64))) is inside


def test_a_constant_focal_length_replaces_those_of_all_cameras() -> None:
    constant = CAMERA.with_constant_f(1300.0)
    assert constant.f.tolist() == [1300.0] * 3
    assert constant.S == CAMERA.S
    assert CAMERA.with_constant_f(None) is CAMERA


def test_several_points_for_each_camera() -> None:
    points = XYZ.expand(2, 3, 3)
    pair = Camera(torch.tensor([[1200.0], [1500.0]], dtype=torch.float64), 224.0)
    torch.testing.assert_close(pair.project(points)[1], camera(1500.0).project(XYZ))


@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan"), float("inf")])
def test_refuses_what_is_not_positive_and_finite(bad: float) -> None:
    with pytest.raises(ValueError, match=f"f, the focal length in pixels, must be positive.*1 of 2 .*{bad}"):
        Camera(torch.tensor([1500.0, bad]), 224.0)
    with pytest.raises(ValueError, match=f"S, the side of the image in pixels, must be positive.*{bad}"):
        camera(1500.0, bad)

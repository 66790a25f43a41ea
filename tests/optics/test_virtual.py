"""Virtual cameras: rotations without roll, exact homographies and labels, and what is too wide to be seen."""

import math

import numpy as np
import pytest
import torch

from phd_exp.data.crops import corners_of
from phd_exp.geometry.motion import smallest_rotation
from phd_exp.optics.virtual import Box, VirtualCamera, intrinsics, rays

S = 96.0


def K(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    return intrinsics(float(fx), float(fy), float(cx), float(cy))


CASES: dict[str, tuple[np.ndarray, Box]] = {
    "whole": (K(900, 900, 320, 240), (0, 0, 640, 480)),
    "off centre": (K(900, 900, 320, 240), (400, 30, 620, 140)),
    "unequal": (K(700, 1100, 250.5, 301.25), (10, 250, 130, 470)),
    "beyond the image": (K(700, 1100, 250.5, 301.25), (-80, -30, 60, 200)),
    "wide": (K(300, 310, 320, 240), (320, 240, 640, 480)),
    "principal point outside": (K(900, 950, -200, 900), (100, 100, 300, 200)),
    "tall and thin": (K(900, 900, 320, 240), (100, 0, 103, 480)),
}


@pytest.fixture(params=CASES.values(), ids=CASES.keys())
def case(request: pytest.FixtureRequest) -> tuple[np.ndarray, Box, VirtualCamera]:
    K, box = request.param
    return K, box, VirtualCamera.of_box(K, tuple(map(float, box)), S)


def pixels(homogeneous: np.ndarray) -> np.ndarray:
    return homogeneous[..., :2] / homogeneous[..., 2:]


def mapped(H: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    return pixels(np.concatenate([pixel, np.ones_like(pixel[..., :1])], axis=-1) @ H.T)


def inside(box: Box, n: int = 40) -> np.ndarray:
    left, top, right, bottom = box
    return np.random.default_rng(0).uniform((left, top), (right, bottom), (n, 2))


def test_both_cameras_agree_on_every_position(case: tuple) -> None:
    """Real projection, then the homography == projection of R xyz: labels and pixels tell the same."""
    K, box, camera = case
    depth = np.random.default_rng(1).uniform(0.5, 20, (40, 1))
    xyz = depth * rays(K, inside(box))
    K_v = intrinsics(camera.f, camera.f, S / 2, S / 2)
    expected = pixels(camera.to_virtual(xyz) @ K_v.T)
    np.testing.assert_allclose(mapped(camera.homography, pixels(xyz @ K.T)), expected, atol=1e-8)


def test_the_box_is_in_the_middle_and_a_corner_on_the_edge_without_roll(case: tuple) -> None:
    """The axis lies in the image plane (R is symmetric there), and the angle is that of the ray itself."""
    K, (left, top, right, bottom), camera = case
    middle = np.array([(left + right) / 2, (top + bottom) / 2])
    np.testing.assert_allclose(mapped(camera.homography, middle), [S / 2, S / 2], atol=1e-9)
    corners = np.array([[left, top], [right, top], [left, bottom], [right, bottom]], dtype=float)
    assert np.abs(mapped(camera.homography, corners) - S / 2).max() == pytest.approx(S / 2)
    np.testing.assert_allclose(camera.R @ camera.R.T, np.eye(3), atol=1e-15)
    assert camera.R[0, 1] == camera.R[1, 0]
    ray = rays(K, middle)
    angle = math.acos(min(1.0, (np.trace(camera.R) - 1) / 2))
    assert angle == pytest.approx(math.acos(ray[2] / np.linalg.norm(ray)), abs=1e-7)
    xyz = np.random.default_rng(2).normal(size=(5, 4, 3))
    np.testing.assert_allclose(camera.to_real(camera.to_virtual(xyz)), xyz, atol=1e-14)


def test_the_whole_image_of_a_square_camera_is_that_camera() -> None:
    camera = VirtualCamera.of_box(K(555.5, 555.5, 112, 112), (0.0, 0.0, 224.0, 224.0), 224.0)
    assert np.array_equal(camera.R, np.eye(3))
    assert camera.f == pytest.approx(555.5, rel=1e-15)
    np.testing.assert_allclose(camera.homography, np.eye(3), atol=1e-12)


def test_corners_of_pixels_are_mapped_by_the_homography(case: tuple) -> None:
    camera = case[2]
    places = np.stack(np.meshgrid(np.arange(S + 1), np.arange(S + 1)), axis=-1)
    np.testing.assert_allclose(mapped(camera.homography, corners_of(camera)), places, atol=1e-8)


@pytest.mark.parametrize("direction", [(0, 0, 1), (0.6, 0, 0.8), (0, -0.6, 0.8), (0.48, 0.64, 0.6)])
def test_smallest_rotation_takes_the_direction_to_the_axis(direction: tuple[float, ...]) -> None:
    vector = torch.tensor(direction, dtype=torch.float64)
    np.testing.assert_allclose(smallest_rotation(vector) @ vector, [0, 0, 1], atol=1e-15)


def test_refuses_what_no_pinhole_image_shows() -> None:
    wide = K(10, 10, 500, 500)
    with pytest.raises(ValueError, match="corners are 90 degrees or more"):
        VirtualCamera.of_box(wide, (490.0, 490.0, 5000.0, 5000.0), S)
    with pytest.raises(ValueError, match="square view of it reaches 90 degrees"):
        VirtualCamera.of_box(K(100, 100, 0, 0), (100.0, -400.0, 500.0, 400.0), S)

"""Lenses against OpenCV, to and fro; where they fold over; and virtual cameras behind them."""

import numpy as np
import pytest

from phd_exp.data.crops import corners_of
from phd_exp.optics.lens import PINHOLE, Lens
from phd_exp.optics.virtual import Box, VirtualCamera, intrinsics, rays, require_no_fold
from tests.support.opencv import projected, undistorted

K = intrinsics(500.0, 510.0, 320.5, 240.5)
LENSES = {
    "barrel": Lens((-0.28, 0.07, 0.0005, -0.0003)),
    "five coefficients": Lens((-0.28, 0.1, 0.002, -0.001, -0.01)),
    "pincushion": Lens((0.1, 0.05, 0.0, 0.0, 0.01)),
    "rational": Lens((2.1, 1.2, 0.0003, -0.0002, 0.05, 2.4, 1.8, 0.3)),
    "equidistant": Lens((0.0, 0.0, 0.0, 0.0), is_fisheye=True),
    "Kannala-Brandt": Lens((-0.03, 0.004, -0.002, 0.0003), is_fisheye=True),
}
of_each_lens = pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES.keys())


def directions(widest: float, n: int = 2000) -> np.ndarray:
    """Unit vectors within an angle, radians, of the axis, and the axis itself."""
    draw = np.random.default_rng(0)
    angle, turn = widest * np.sqrt(draw.uniform(0, 1, n)), draw.uniform(0, 2 * np.pi, n)
    xyz = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=-1)
    return np.concatenate([xyz, [[0.0, 0.0, 1.0]]])


@of_each_lens
def test_distorts_and_undistorts_as_opencv(lens: Lens) -> None:
    """To 1e-6 px, up to 120 degrees of field."""
    xyz = directions(min(np.radians(60), 0.99 * lens.limit))
    pixel = K[:2, 2] + np.diagonal(K)[:2] * lens.distort(xyz)
    np.testing.assert_allclose(pixel, projected(xyz, K, lens), rtol=0, atol=1e-6)
    theirs, ours = undistorted(pixel, K, lens), rays(K, pixel, lens)
    again = projected(np.concatenate([theirs, np.ones_like(theirs[:, :1])], axis=-1), K, lens)
    converged = np.abs(again - pixel).max(axis=-1) < 1e-8  # the fixed point of OpenCV 4 may be no attractor
    assert converged.mean() > 0.3
    difference = 500 * (ours[:, :2] / ours[:, 2:] - theirs)[converged]
    assert np.abs(difference).max() < 1e-6


@of_each_lens
def test_undistorting_is_the_inverse_up_to_the_fold(lens: Lens) -> None:
    xyz = directions(min(0.97 * lens.limit, np.radians(179 if lens.is_fisheye else 85)))
    ray = lens.undistort(lens.distort(xyz))
    np.testing.assert_allclose(ray / np.linalg.norm(ray, axis=-1, keepdims=True), xyz, rtol=0, atol=1e-9)


def test_without_coefficients_it_is_a_pinhole() -> None:
    xyz = directions(1.5)
    np.testing.assert_allclose(PINHOLE.distort(xyz), xyz[:, :2] / xyz[:, 2:], rtol=1e-12, atol=1e-15)
    assert Lens((0.0,) * 8).is_pinhole
    assert not Lens((0.0,) * 4, is_fisheye=True).is_pinhole
    assert np.isnan(PINHOLE.distort(np.array([1.0, 0.0, -1.0]))).all()


@pytest.mark.parametrize(("k1", "is_fisheye"), [(-0.3, False), (-1.0, False), (-0.1, True)])
def test_folds_where_the_derivative_vanishes(k1: float, is_fisheye: bool) -> None:
    """d/ds s (1 + k1 s^2) = 0 at s = (-3 k1)^-1/2; nothing has its image beyond."""
    lens, s = Lens((k1,), is_fisheye), (-3 * k1) ** -0.5
    angle = s if is_fisheye else np.arctan(s)
    assert lens.limit == pytest.approx(angle, abs=2e-3)
    beyond = np.array([np.sin(angle + 0.01), 0.0, np.cos(angle + 0.01)])
    assert np.isnan(lens.distort(beyond)).all()
    assert np.isnan(lens.undistort(np.array([2 / 3 * s + 1e-3, 0.0]))).all()
    radius = 2 / 3 * s * 500
    require_no_fold(intrinsics(500.0, 500.0, 0.98 * radius, 5.0), lens, int(1.96 * radius), 10)
    width = int(2 * 1.2 * radius)
    with pytest.raises(ValueError, match=rf"folds over inside the image of {width} x 10 pixels") as caught:
        require_no_fold(intrinsics(500.0, 500.0, width / 2, 5.0), lens, width, 10)
    said = float(str(caught.value).split(" pixels, ")[1].split()[0])
    assert said == pytest.approx(np.degrees(angle), abs=0.2)


def test_tangential_terms_can_fold_too_and_a_circular_fisheye_does_not() -> None:
    with pytest.raises(ValueError, match=r"folds over inside the image of 640 x 480 pixels, [0-9.]+ degrees"):
        require_no_fold(K, Lens((0.0, 0.0, 0.3, 0.0)), 640, 480)
    require_no_fold(intrinsics(100.0, 100.0, 500.0, 500.0), LENSES["equidistant"], 1000, 1000)


@of_each_lens
def test_the_view_contains_the_border_of_the_box_and_faces_its_middle(lens: Lens) -> None:
    box = (60.0, 30.0, 300.0, 220.0)
    camera = VirtualCamera.of_box(K, box, 96.0, lens)
    np.testing.assert_allclose(camera.real_pixels(np.zeros(2)), [180, 125], atol=1e-6)
    u, v = np.random.default_rng(0).uniform((60, 30), (300, 220), (500, 2)).T
    seen = camera.to_virtual(rays(K, np.stack([u, v], axis=-1), lens))
    places = np.abs(seen[:, :2] / seen[:, 2:]) * camera.f
    assert places.max() < 48.05


@pytest.mark.parametrize("box", [(60.0, 30.0, 300.0, 220.0), (0.0, 0.0, 640.0, 480.0)], ids=["box", "whole"])
@pytest.mark.parametrize("lens", [*LENSES.values(), Lens((-0.3,)), PINHOLE], ids=[*LENSES, "folds", "pinhole"])
def test_corners_of_pixels_are_exact(lens: Lens, box: Box) -> None:
    """Also where a lens folds over, which leaves NaN."""
    box = (320.0, 0.0, 840.0, 480.0) if lens.coefficients == (-0.3,) else box
    camera = VirtualCamera.of_box(K, box, 96.0, lens)
    along = (np.arange(97) - 48) / camera.f
    exact = camera.real_pixels(np.stack(np.meshgrid(along, along), axis=-1))
    assert np.isnan(exact).any() == (lens.coefficients == (-0.3,))
    np.testing.assert_allclose(corners_of(camera), exact, rtol=0, atol=2e-9)


def test_a_fisheye_has_views_beyond_90_degrees() -> None:
    fisheye = intrinsics(200.0, 200.0, 500.0, 500.0)
    camera = VirtualCamera.of_box(fisheye, (820.0, 460.0, 900.0, 540.0), 64.0, LENSES["equidistant"])
    assert np.degrees(np.arccos(camera.R[2, 2])) == pytest.approx(np.degrees(360 / 200))
    with pytest.raises(ValueError, match="90 degrees or more from its middle"):
        VirtualCamera.of_box(fisheye, (0.0, 0.0, 1000.0, 1000.0), 64.0, LENSES["equidistant"])
    with pytest.raises(ValueError, match="beyond the field of the lens"):
        VirtualCamera.of_box(fisheye, (1200.0, 460.0, 1300.0, 540.0), 64.0, LENSES["equidistant"])

"""Photographs through lenses: a ball lies where the virtual camera projects it, and what has no image is grey."""

import numpy as np
import pytest
import torch
from PIL import Image

from phd_exp.data import crops
from phd_exp.data.areas import GREY, area_means, sums
from phd_exp.data.crops import corners_of, cut
from phd_exp.optics.lens import Lens
from phd_exp.optics.virtual import Box, VirtualCamera, intrinsics, rays
from tests.support.opencv import projected

WIDTH, HEIGHT, FINE = 1280, 960, 8
LENSES = {
    "barrel, 70 degrees": (Lens((-0.28, 0.1, 0.0008, -0.0005, -0.01)), 35),
    "pincushion, 60 degrees": (Lens((0.12, -0.02, -0.0006, 0.0004)), 30),
    "rational, 120 degrees": (Lens((2.1, 1.2, 0.0003, -0.0002, 0.05, 2.4, 1.8, 0.3)), 60),
    "equidistant, 120 degrees": (Lens((0.0, 0.0, 0.0, 0.0), is_fisheye=True), 60),
    "Kannala-Brandt, 120 degrees": (Lens((-0.03, 0.004, -0.002, 0.0003), is_fisheye=True), 60),
}
of_each_lens = pytest.mark.parametrize(("lens", "half_field"), LENSES.values(), ids=LENSES.keys())


def camera_of(lens: Lens, half_field: float) -> np.ndarray:
    """Intrinsics with which the lens shows that angle, degrees, at the left and right edge."""
    edge = lens.distort(np.array([np.sin(np.radians(half_field)), 0.0, np.cos(np.radians(half_field))]))[0]
    return intrinsics(WIDTH / 2 / edge, 1.02 * WIDTH / 2 / edge, WIDTH / 2 + 7.3, HEIGHT / 2 - 4.1)


def photograph(K: np.ndarray, lens: Lens, ball: np.ndarray, radius: float) -> Image.Image:
    """A white ball on black: the cone of its tangents, as OpenCV projects it, sampled 8 x 8 times a pixel."""
    distance, turn = np.linalg.norm(ball), np.linspace(0, 2 * np.pi, 2000)[:, None]
    first, second = np.linalg.svd(ball[None])[2][1:]
    outline = np.sqrt(distance**2 - radius**2) * ball / distance
    outline = outline + radius * (np.cos(turn) * first + np.sin(turn) * second)
    pixels = projected(outline, K, lens)
    corner = np.floor(pixels.mean(axis=0)).astype(int) - 100
    x, y = (pixels - corner - 100).T
    order = np.argsort(np.arctan2(y, x))
    u, v = np.meshgrid(*2 * [(np.arange(200 * FINE) + 0.5) / FINE - 100])
    reach = np.interp(np.arctan2(v, u), np.arctan2(y, x)[order], np.hypot(x, y)[order], period=2 * np.pi)
    share = (np.hypot(u, v) < reach).reshape(200, FINE, 200, FINE).mean(axis=(1, 3))
    image = Image.new("RGB", (WIDTH, HEIGHT))
    image.paste(Image.fromarray(np.round(255 * share).astype(np.uint8)).convert("RGB"), tuple(corner.tolist()))
    return image


@of_each_lens
@pytest.mark.parametrize("pixel", [(640, 480), (1000, 300), (1080, 760)], ids=["middle", "between", "corner"])
def test_the_centroid_of_a_ball_is_within_a_twentieth_of_a_pixel(
    lens: Lens, half_field: float, pixel: tuple[int, int]
) -> None:
    """Its outline in a pinhole is an ellipse about f (x, y) z / (z^2 - r^2), by the cone of its tangents."""
    K, radius = camera_of(lens, half_field), 0.2
    ray = rays(K, np.array(pixel, dtype=float), lens)
    ball = 4 * ray / np.linalg.norm(ray)
    image = photograph(K, lens, ball, radius)
    left, top, right, bottom = image.getbbox()  # type: ignore[misc]
    assert 0 < left < right < WIDTH
    assert 0 < top < bottom < HEIGHT, "whole"
    for S in (64, 160):
        camera = VirtualCamera.of_box(K, (left - 4.0, top - 6.0, right + 5.0, bottom + 3.0), float(S), lens)
        x, y, z = camera.to_virtual(ball)
        expected = camera.f * np.array([x, y]) * z / (z**2 - radius**2) + S / 2
        light = cut(image, camera)[..., 0].astype(float)
        v, u = np.indices(light.shape) + 0.5
        centroid = np.array([(u * light).sum(), (v * light).sum()]) / light.sum()
        assert np.abs(centroid - expected).max() < 0.05


def test_what_has_no_image_is_grey() -> None:
    """Beyond the edge of the photograph, and beyond the angle at which the lens folds over."""
    lens, K = Lens((-0.3,)), intrinsics(500.0, 500.0, 300.0, 300.0)
    white = Image.new("RGB", (600, 600), (255, 255, 255))
    camera = VirtualCamera.of_box(K, (420.0, 100.0, 640.0, 320.0), 64.0, lens)
    view = cut(white, camera)
    x, y = np.meshgrid(*2 * [(np.arange(64) + 0.5 - 32) / camera.f])
    columns = camera.real_pixels(np.stack([x, y], axis=-1))[..., 0]
    lost = np.isnan(columns)
    assert (view[columns < 597] == 255).mean() > 0.98
    assert (view[columns > 603] == GREY).all()
    assert lost.sum() > 100
    assert (view[lost] == GREY).mean() > 0.9, "but for pixels at the edge"


@pytest.mark.parametrize("box", [(100.0, 80.0, 900.0, 800.0), (500.0, 300.0, 540.0, 350.0)], ids=str)
def test_a_view_in_strips_is_that_of_the_whole_image(box: Box, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an array and of Pillow's image, to the bit, also beyond the edge and where the lens folds over."""
    noise = np.random.default_rng(0).integers(0, 256, (700, 900, 3), dtype=np.uint8)
    camera = VirtualCamera.of_box(intrinsics(900.0, 900.0, 450.0, 350.0), box, 64.0, Lens((-0.3,)))
    corners = torch.from_numpy(corners_of(camera))[None]
    (whole,) = area_means(sums(torch.from_numpy(noise)), corners.new_zeros(1, 2), corners).numpy()
    for pixels in (crops.STRIP, 10_000, 1):
        monkeypatch.setattr(crops, "STRIP", pixels)
        np.testing.assert_array_equal(cut(noise, camera), whole)
        np.testing.assert_array_equal(cut(Image.fromarray(noise), camera), whole)

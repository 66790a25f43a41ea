"""The virtual cameras of exported graphs are those of `predict`."""

import numpy as np
import pytest
import torch

from phd_exp.data.crops import corners_of
from phd_exp.geometry.facing import facing, pixel_corners
from phd_exp.optics.virtual import VirtualCamera, intrinsics

K = intrinsics(700.0, 1100.0, 250.5, 301.25)
BOXES = np.array([[10, 250, 130, 470], [0, 0, 640, 480], [-40, 100, 90, 101], [600, 440, 620, 470]], dtype=float)
S = 64


@pytest.mark.parametrize("largest_f", [float("inf"), 500.0])
def test_they_are_those_of_each_box(largest_f: float) -> None:
    given = torch.from_numpy(K), torch.from_numpy(BOXES)
    R, f = facing(*given, S, largest_f)
    origin, corners = pixel_corners(*given, R, f, S)
    assert torch.equal(origin, origin.round())
    corners = origin[:, None, None] + corners
    assert (f <= largest_f).all()
    for number, box in enumerate(BOXES.tolist()):
        camera = VirtualCamera.of_box(K, tuple(box), float(S), largest_f=largest_f)
        np.testing.assert_allclose(R[number], camera.R, atol=1e-14)
        assert f[number].item() == pytest.approx(camera.f, rel=1e-12)
        np.testing.assert_allclose(corners[number], corners_of(camera), atol=1e-9)


def test_a_small_box_is_viewed_no_closer_than_asked() -> None:
    box = (600.0, 440.0, 620.0, 470.0)
    close, wide = (VirtualCamera.of_box(K, box, float(S), largest_f=f) for f in (np.inf, 500.0))
    assert close.f > 2000
    assert wide.f == 500
    np.testing.assert_array_equal(close.R, wide.R)

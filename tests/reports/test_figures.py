"""Pictures from records alone."""

from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from PIL import Image

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.level_curves import level_curves, on_image
from phd_exp.reports.figures import draw_birds_eye, draw_calibration, draw_on_image


def test_a_calibration_picture_has_ink(tmp_path: Path) -> None:
    predicted = np.geomspace(1e-4, 1e-1, 50)
    curve = {"predicted": predicted.tolist(), "empirical": (2 * predicted).tolist(), "window": 200, "left_out": 0}
    draw_calibration({"depth": curve, "projected": curve}, tmp_path / "curve.png")
    with Image.open(tmp_path / "curve.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    assert (np.abs(pixels - (31, 119, 180)).max(axis=-1) < 30).sum() > 300  # the curves, blue
    assert (np.abs(pixels - (214, 39, 40)).max(axis=-1) < 90).sum() > 100  # the identities, red and thin


def test_the_figure_shows_curves_mode_and_truth() -> None:
    one = torch.tensor(1.0, dtype=torch.float64)
    curves = level_curves(ProjectedHuber(torch.zeros(2).double(), 4 * one, 200 * torch.eye(2).double(), 20 * one))
    truth = np.array([0.25, -0.1, 4.2])
    left, right = Figure().subplots(1, 2)
    draw_on_image(left, curves, np.zeros((224, 224, 3), dtype=np.uint8), 1500.0, 224.0, truth)
    draw_birds_eye(right, curves, truth)
    assert len(left.images) == 1
    for axes, dot in ((left, on_image(truth[:2] / truth[2], 1500.0, 224.0)), (right, truth[::2])):
        *outlines, mode, last = axes.lines
        assert [len(line.get_xdata()) > 10 for line in outlines] == [True] * 3
        assert mode.get_marker() == "x"
        np.testing.assert_allclose(np.ravel(last.get_data()), dot)

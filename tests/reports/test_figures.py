"""Pictures from records alone."""

from pathlib import Path

import numpy as np
from PIL import Image

from phd_exp.reports.figures import draw_calibration


def test_a_calibration_picture_has_ink(tmp_path: Path) -> None:
    predicted = np.geomspace(1e-4, 1e-1, 50)
    curve = {
        "predicted": predicted.tolist(),
        "empirical": (2 * predicted).tolist(),
        "window": 200,
        "left_out": 0,
    }
    draw_calibration({"depth": curve, "projected": curve}, tmp_path / "curve.png")
    with Image.open(tmp_path / "curve.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    assert (np.abs(pixels - (31, 119, 180)).max(axis=-1) < 30).sum() > 300  # the curves, blue
    assert (np.abs(pixels - (214, 39, 40)).max(axis=-1) < 90).sum() > 100  # the identities, red and thin

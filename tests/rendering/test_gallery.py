"""The pictures of the README show what a data set would hold."""

import io
import runpy
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.level_curves import level_curves
from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.spec import DatasetSpec

DRAW = runpy.run_path(str(Path(__file__).parents[2] / "renders" / "draw.py"))
GAP, LABEL, MARK, ZOOM = (DRAW[name] for name in ("GAP", "LABEL", "MARK", "ZOOM"))


def test_samples_stand_in_rows_and_columns(small: DatasetFolder, small_spec: DatasetSpec, tmp_path: Path) -> None:
    DRAW["draw_gallery"](tmp_path / "gallery.jpg", [small_spec, small_spec], [4, 2, 0])
    with Image.open(tmp_path / "gallery.jpg") as picture:
        sheet = np.asarray(picture).astype(int)
    side = 56
    assert sheet.shape == (2 * (side + LABEL) + GAP, 3 * side + 2 * GAP, 3)
    assert all(sheet[top : top + LABEL].min() < 100 for top in (0, side + LABEL + GAP)), "a label above each row"
    with Image.open(small.image_path("train", 2)) as image:
        shown = sheet[-side:, side + GAP : 2 * side + GAP]
        assert np.abs(shown - np.asarray(image).astype(int)).mean() < 6


def test_the_centre_is_marked_where_the_record_says(
    small: DatasetFolder, small_spec: DatasetSpec, tmp_path: Path
) -> None:
    DRAW["draw_camera"](tmp_path / "camera.png", small_spec, 4)
    record = small.records("train")[4]
    u, v = (int(ZOOM * (record.f * place / record.z + record.S / 2)) for place in (record.x, record.y))
    with Image.open(io.BytesIO((tmp_path / "camera.png").read_bytes())) as picture:
        assert picture.height == ZOOM * record.S
        assert picture.getpixel((u, v)) == MARK


def test_a_glance_marks_the_truth_and_explains_itself_once() -> None:
    one = torch.tensor(1.0, dtype=torch.float64)
    curves = level_curves(ProjectedHuber(torch.zeros(2).double(), 4 * one, 200 * torch.eye(2).double(), 20 * one))
    row = {"x": 0.02, "y": -0.01, "z": 4.2, "f": 1500.0, "S": 224.0}
    values = [1e-3, 1e-2, 1e-1]
    calibration = {"predicted": values, "empirical": values, "window": 100, "left_out": 0}
    figure = DRAW["glance"](row, np.zeros((224, 224, 3), np.uint8), curves, calibration)
    assert all(axes.get_title() for axes in figure.axes)
    assert [axes.get_legend() for axes in figure.axes] == [None] * 3
    (legend,) = figure.legends
    words = [text.get_text() for text in legend.get_texts()]
    assert len(words) == len(set(words))
    assert {"50 %", "90 %", "99 %", "mode", "truth", "calibrated"} <= set(words)
    dots = [np.ravel(axes.lines[-1].get_data()) for axes in figure.axes[:2]]
    np.testing.assert_allclose(dots[0], np.array([row["x"], row["y"]]) / row["z"] * row["f"] + row["S"] / 2)
    np.testing.assert_allclose(dots[1], [row["x"], row["z"]])

"""The gallery shows the images it is asked for, one data set a row."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from phd_exp.records.dataset import DatasetFolder
from phd_exp.rendering.errors import RenderError
from phd_exp.rendering.gallery import GAP, draw_gallery


def test_images_stand_in_rows_and_columns(small: DatasetFolder, tmp_path: Path) -> None:
    draw_gallery(tmp_path / "gallery.jpg", [small, small], [4, 2, 0])
    with Image.open(tmp_path / "gallery.jpg") as picture:
        sheet = np.asarray(picture).astype(int)
    side = 56
    assert sheet.shape == (2 * side + GAP, 3 * side + 2 * GAP, 3)
    with Image.open(small.image_path("train", 2)) as image:
        shown = sheet[side + GAP :, side + GAP : 2 * side + GAP]
        assert np.abs(shown - np.asarray(image).astype(int)).mean() < 6


def test_what_is_not_rendered_is_named(small: DatasetFolder, tmp_path: Path) -> None:
    with pytest.raises(RenderError, match=r"000099\.png: not rendered yet"):
        draw_gallery(tmp_path / "gallery.jpg", [small], [99])
    with pytest.raises(RenderError, match="at least one"):
        draw_gallery(tmp_path / "gallery.jpg", [], [0])
    assert not (tmp_path / "gallery.jpg").exists()

"""The pictures of the README show what a data set would hold."""

import io
import runpy
from pathlib import Path

import numpy as np
from PIL import Image

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

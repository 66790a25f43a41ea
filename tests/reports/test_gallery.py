"""The choice of pictures, the positions in them, and the files that are never opened."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from phd_exp.distributions.level_curves import on_image
from phd_exp.evaluation.parquet import Arrays, read_table
from phd_exp.records.errors import RunError
from phd_exp.reports.gallery import EACH, LARGEST, birds_eye_view, close_up, curves_of, load_image, make_gallery
from tests.support.synthetic import write_run


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Arrays:
    return read_table(write_run(tmp_path_factory.mktemp("distribution"), n=60).predictions)


@pytest.fixture(scope="module")
def row(table: Arrays) -> dict:
    return {name: column[0] for name, column in table.items()}


def test_the_best_and_the_worst_by_their_density(table: Arrays) -> None:
    gallery = make_gallery(table, {})
    names = table["file_name"][np.argsort(table["nll"])].tolist()
    assert [picture.name for picture in gallery.best] == names[:EACH]
    assert [picture.name for picture in gallery.worst] == names[::-1][:EACH]
    assert "images are your own" in gallery.note


def test_a_baseline_is_ranked_by_distance_and_has_no_curves(tmp_path: Path) -> None:
    table = read_table(write_run(tmp_path, model="mae_vz", n=30).predictions)
    off = np.linalg.norm([table[f"mode_{axis}"] - table[axis] for axis in "xyz"], axis=0)
    gallery = make_gallery(table, {"data.root": "gone", "data.spec.variant": "default"})
    assert gallery.note.startswith("gone/default/test: the renders of this run are missing")
    picture = gallery.worst[0]
    assert picture.name == table["file_name"][off.argmax()]
    assert (picture.panel.paths, picture.birds_eye, picture.image) == ([], None, None)


def test_marks_lie_where_the_camera_sees_them(table: Arrays) -> None:
    picture = make_gallery(table, {}).best[0]
    (place,) = np.flatnonzero(table["file_name"] == picture.name)
    for mark, prefix in ((picture.panel.truth, ""), (picture.panel.mode, "mode_")):
        u = np.array([table[f"{prefix}x"][place], table[f"{prefix}y"][place]]) / table[f"{prefix}z"][place]
        np.testing.assert_allclose(mark, on_image(u, float(table["f"][place]), 224.0), atol=0.01)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 7.0, 300.0])
def test_the_birds_eye_view_has_few_round_ticks_on_the_scale_of_its_marks(row: dict, scale: float) -> None:
    curves = curves_of(row)
    assert curves is not None
    truth = curves.mode + scale * np.array([0.3, 0.0, -0.7])
    view = birds_eye_view(curves, truth)
    for place, ticks, value in ((0, view.x_ticks, truth[0]), (1, view.z_ticks, truth[2])):
        at, texts = zip(*ticks, strict=True)
        assert 2 <= len(set(texts)) == len(texts) <= 6
        values = [float(text.replace("−", "-")) for text in texts]
        slope, offset = np.polyfit(values, at, 1)
        np.testing.assert_allclose(slope * np.array(values) + offset, at, atol=0.02)
        assert view.truth[place] == pytest.approx(slope * value + offset, abs=0.05)


def test_only_close_points_have_a_close_up() -> None:
    near = np.array([[100.0, 50.0], [110.0, 52.0]])
    left, top, side = close_up(near, 224.0) or (0, 0, 0)
    assert (near >= (left, top)).all()
    assert (near <= (left + side, top + side)).all()
    assert close_up(np.array([[0.0, 0.0], [200.0, 10.0]]), 224.0) is None
    assert close_up(np.array([[np.nan, 0.0], [1.0, 1.0]]), 224.0) is None


def test_only_images_of_their_folder_are_read(tmp_path: Path) -> None:
    folder = tmp_path / "test"
    folder.mkdir()
    Image.new("RGB", (1000, 500)).save(folder / "large.png")
    Image.new("RGB", (10, 10)).save(tmp_path / "secret.png")
    Image.new("RGB", (10, 10)).save(folder / "other.gif")
    (folder / "no.png").write_text("no image")
    assert load_image(folder, "large.png").size == (LARGEST, LARGEST // 2)  # type: ignore[union-attr]
    for name in ("../secret.png", str(tmp_path / "secret.png"), "other.gif", "no.png", "missing.png", "."):
        assert load_image(folder, name) is None, name


def test_what_cannot_be_drawn_is_said_or_left_out(table: Arrays, row: dict) -> None:
    with pytest.raises(RunError, match="no column file_name, f, as in older records; run the model again"):
        make_gallery({name: table[name] for name in table if name not in ("file_name", "f")}, {})
    assert curves_of(row | {"a": -1.0}) is None
    assert curves_of(row | {"A_xx": float("nan")}) is None

"""Which pictures a gallery shows, where things lie in them, and what it never opens."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from PIL import Image

from phd_exp.distributions.level_curves import on_image
from phd_exp.records.errors import RunError
from phd_exp.reports.site.gallery import EACH, LARGEST, curves_of, load_image, make_gallery
from phd_exp.reports.site.panels import birds_eye_view, close_up
from tests.reports.site.synthetic import write_run


@pytest.fixture(scope="module")
def distribution(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("distribution"), n=60).predictions


def test_the_best_and_the_worst_by_their_density(distribution: Path, tmp_path: Path) -> None:
    table = pq.read_table(distribution)
    gallery = make_gallery(table, {}, tmp_path)
    names = table["file_name"].to_numpy()[np.argsort(table["nll"].to_numpy())]
    assert [picture.name for picture in gallery.best] == names[:EACH].tolist()
    assert [picture.name for picture in gallery.worst] == names[::-1][:EACH].tolist()
    assert "images are your own" in gallery.notes[0]


def test_a_baseline_is_ranked_by_distance_and_has_no_curves(tmp_path: Path) -> None:
    table = pq.read_table(write_run(tmp_path, model="mae_vz", n=30).predictions)
    truth, mode = (np.stack([table[prefix + axis].to_numpy() for axis in "xyz"]) for prefix in ("", "mode_"))
    worst = table["file_name"].to_numpy()[np.linalg.norm(mode - truth, axis=0).argmax()]
    picture = make_gallery(
        table, {"data.root": "gone", "data.spec.variant": "default"}, tmp_path / "out"
    ).worst[0]
    assert picture.name == worst
    assert (picture.paths, picture.birds_eye, picture.image) == ([], None, None)


def test_marks_lie_where_the_camera_sees_them(distribution: Path, tmp_path: Path) -> None:
    table = pq.read_table(distribution)
    picture = make_gallery(table, {}, tmp_path).best[0]
    (row,) = (row for row in table.to_pylist() if row["file_name"] == picture.name)
    for mark, prefix in ((picture.truth, ""), (picture.mode, "mode_")):
        u = np.array([row[f"{prefix}x"], row[f"{prefix}y"]]) / row[f"{prefix}z"]
        np.testing.assert_allclose(mark, on_image(u, row["f"], 224), atol=0.01)


def test_the_birds_eye_view_places_ticks_and_marks_on_one_scale(distribution: Path) -> None:
    row = pq.read_table(distribution).to_pylist()[0]
    curves = curves_of(row)
    assert curves is not None
    view = birds_eye_view(curves, np.array([row["x"], row["y"], row["z"]]))
    for place, ticks, value in ((0, view.x_ticks, row["x"]), (1, view.z_ticks, row["z"])):
        at, text = zip(*ticks, strict=True)
        values = [float(label.replace("−", "-")) for label in text]
        slope, offset = np.polyfit(values, at, 1)
        assert view.truth[place] == pytest.approx(slope * value + offset, abs=0.05)


def test_only_what_lies_close_together_is_enlarged() -> None:
    near = np.array([[100.0, 50.0], [110.0, 52.0]])
    left, top, side = close_up(near, 224.0) or (0, 0, 0)
    assert (near >= (left, top)).all()
    assert (near <= (left + side, top + side)).all()
    assert close_up(np.array([[0.0, 0.0], [200.0, 10.0]]), 224.0) is None
    assert close_up(np.array([[np.nan, 0.0], [1.0, 1.0]]), 224.0) is None


def test_images_are_read_from_their_folder_alone(tmp_path: Path) -> None:
    folder = tmp_path / "test"
    folder.mkdir()
    Image.new("RGB", (1000, 500)).save(folder / "large.png")
    Image.new("RGB", (10, 10)).save(tmp_path / "secret.png")
    Image.new("RGB", (10, 10)).save(folder / "other.gif")
    (folder / "no.png").write_text("no image")
    assert load_image(folder, "large.png").size == (LARGEST, LARGEST // 2)  # type: ignore[union-attr]
    for name in ("../secret.png", str(tmp_path / "secret.png"), "other.gif", "no.png", "missing.png", "."):
        assert load_image(folder, name) is None, name


def test_a_table_without_its_columns_is_one_line(distribution: Path, tmp_path: Path) -> None:
    table = pq.read_table(distribution).drop_columns(["file_name", "f"])
    with pytest.raises(RunError, match="lack the column file_name, f; run the model again"):
        make_gallery(table, {}, tmp_path)


def test_numbers_that_are_no_distribution_have_no_curves(distribution: Path) -> None:
    row = pq.read_table(distribution).to_pylist()[0]
    assert curves_of(row | {"a": -1.0}) is None
    assert curves_of(row | {"A_xx": float("nan")}) is None

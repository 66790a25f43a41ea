"""`predict` and `load` with a network of random weights: what they read, what they write, and mistakes."""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from PIL import Image

import phd_exp as package
from phd_exp.distributions import ProjectedHuber
from phd_exp.geometry import Lens, VirtualCamera, intrinsics
from phd_exp.inference import pictures
from phd_exp.inference.answers import Answers, Sighting
from phd_exp.inference.predictor import PredictedViews
from phd_exp.records.detections import detections_of
from phd_exp.records.errors import DatasetError, RunError
from phd_exp.records.runs import RunFolder
from tests.evaluation.test_conformal import table_of
from tests.support.recorded import status_of
from tests.support.untrained import (
    NOWHERE,
    SIDE,
    read_lines,
    read_metadata,
    virtual_cameras,
    write_metadata,
    write_photos,
)


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photos") / "test"
    write_photos(folder, 4)
    return folder


@pytest.fixture(scope="module")
def run(make: Callable[..., RunFolder]) -> RunFolder:
    return make(*NOWHERE)


@pytest.fixture(scope="module")
def baseline(make: Callable[..., RunFolder]) -> RunFolder:
    return make(*NOWHERE, "model=mae_constf")


def test_a_pattern_and_several_folders_are_predicted_as_their_files(
    phd_exp: Callable, run: RunFolder, tmp_path: Path
) -> None:
    for name in ("a/1.png", "b/1.png", "b/2.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        Image.fromarray(np.full((40, 40, 3), 90, np.uint8)).save(tmp_path / name)
        line = json.dumps({"file_name": Path(name).name, "f": 90})
        with open(tmp_path / name[0] / "metadata.jsonl", "a") as lines:
            lines.write(f"{line}\n")
    given = ["image=a/1.png,b/1.png,b/2.png", "image=?/*.png", "image=a/*.png,b/[12].png"]
    outcomes = [phd_exp("predict", f"run={run.path}", words, "f=90") for words in given]
    outcomes.append(phd_exp("predict", f"run={run.path}", "folder=a,b"))
    assert [outcome.err for outcome in outcomes] == [""] * 4
    assert [row["file_name"] for row in read_lines(outcomes[0].out)] == ["a/1.png", "b/1.png", "b/2.png"]
    assert {outcome.out for outcome in outcomes} == {outcomes[0].out}
    nothing = phd_exp("predict", f"run={run.path}", "image=c/*.png", "f=90")
    assert (nothing.status, "image: " in nothing.error) == (2, True)
    assert "no path matches c/*.png; expected a pattern such as images/*.png" in nothing.error


@pytest.fixture
def spoiled(run: RunFolder, tmp_path: Path) -> RunFolder:
    """A copy of the run, to be changed."""
    return RunFolder(shutil.copytree(run.path, tmp_path / "spoiled"))


def test_answers_are_in_the_frame_of_the_real_camera(phd_exp: Callable, run: RunFolder, photos: Path) -> None:
    """Against samples of the prediction for a crop, turned back."""
    outcome = phd_exp("predict", f"run={run.path}", f"folder={photos}")
    assert (outcome.status, outcome.err) == (0, "")
    predictor, n = package.load(run.path), 100_000
    for row, camera in zip(read_lines(outcome.out)[:2], virtual_cameras(photos), strict=False):
        view = predictor.view(np.asarray(Image.open(photos / row["file_name"])), camera.K, row["box"])
        prediction = predictor.see(view)
        real = camera.to_real(prediction.rsample((n,), torch.Generator().manual_seed(0)).double().numpy())
        for level, (low, high) in row["depth_interval"].items():
            share = int(level) / 100
            inside = ((low < real[:, 2]) & (real[:, 2] < high)).mean()
            assert abs(inside - share) < 4 * np.sqrt(share * (1 - share) / n)
        assert abs((real[:, 2] < row["median_depth"]).mean() - 0.5) < 4 * np.sqrt(0.25 / n)
        scale = np.sqrt(np.diag(row["covariance"]))
        assert np.abs(np.cov(real.T) - row["covariance"]).max() < 0.1 * scale.max() ** 2
        assert np.abs((real.mean(axis=0) - row["mean"]) / scale).max() < 0.02


def test_small_boxes_are_viewed_at_the_largest_focal_length_of_the_training_renders(
    phd_exp: Callable, make: Callable[..., RunFolder], run: RunFolder, tmp_path: Path
) -> None:
    """A network of own images has learned from boxes; there they decide. A whole image is viewed as it is."""
    rendered = make("data=default")
    image, K = np.zeros((100, 200, 3), np.uint8), intrinsics(400.0, 400.0, 100.0, 50.0)
    largest_f = 2000 * SIDE / 224
    for folder, f in ((rendered, largest_f), (run, pytest.approx(400 * SIDE / 8, rel=0.01))):
        assert package.load(folder.path).view(image, K, (50.0, 40.0, 58.0, 48.0)).camera.f == f
    assert package.load(rendered.path).view(image, 10 * K - np.diag([0, 0, 9])).camera.f > largest_f
    Image.fromarray(image).save(tmp_path / "photo.png")
    words = ("predict", f"run={rendered.path}", "image=photo.png", "fx=400", "fy=400", "box=50,40,58,48")
    (answer,) = read_lines(phd_exp(*words).out)
    assert np.isfinite(answer["mode"]).all()


def test_a_baseline_has_positions_without_uncertainty(
    phd_exp: Callable, baseline: RunFolder, photos: Path, tmp_path: Path
) -> None:
    outcome = phd_exp("predict", f"run={baseline.path}", f"folder={photos}")
    assert outcome.status == 0, outcome.err
    rows = read_lines(outcome.out)
    errors = {"projected_error_mm", "depth_error_mm"}
    assert rows[0].keys() == errors | {"file_name", "box", "position", "uncertainty", "warnings", "out_of_field"}
    assert rows[0]["uncertainty"].startswith("none")
    predictor = package.load(baseline.path)
    for row, camera in zip(rows, virtual_cameras(photos), strict=True):
        image = np.asarray(Image.open(photos / row["file_name"]))
        prediction = predictor.see(predictor.view(image, camera.K, row["box"]))
        np.testing.assert_allclose(row["position"], camera.to_real(prediction.mode.numpy()), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    "words",
    [
        "predict recalibrate=true",
        "predict coverage=0.9",
        "predict view=new.rrd",
        "predict out=new.mcap",
        "track out=new",
        "fuse out=new.jsonl",
        "calibrate name=new",
    ],
)
def test_what_needs_densities_refuses_a_baseline(
    phd_exp: Callable, baseline: RunFolder, photos: Path, tmp_path: Path, words: str
) -> None:
    verb, word = words.split()
    pose = {"scene": 0, "pose": {"rotation": [1, 0, 0, 0], "translation": [0, 0, 0]}}
    (tmp_path / "photos").mkdir()
    for line in read_metadata(photos):
        shutil.copy(photos / line["file_name"], tmp_path / "photos")
    lines = [line | pose | {"time": number} for number, line in enumerate(read_metadata(photos))]
    write_metadata(tmp_path / "photos", [{k: v for k, v in one.items() if k not in "xyz"} for one in lines])
    refused = phd_exp(verb, f"run={baseline.path}", "folder=photos", word)
    assert "predicts no Projected Huber densities" in refused.error
    assert refused.out == ""


def test_boxes_of_one_photograph_are_predicted_as_single_ones(
    phd_exp: Callable, run: RunFolder, photos: Path, tmp_path: Path
) -> None:
    words = ("predict", f"run={run.path}", f"image={photos / '0.png'}", "f=300")
    boxes = [[5, 10, 55, 60], [20, 5, 40, 50]]
    known = [{"score": 0.5, "category_id": 0}, {"category_id": 1}]
    items = [{"image_id": 1, "bbox": box} | more for box, more in zip(boxes, known, strict=True)]
    (tmp_path / "boxes.json").write_text(json.dumps(items))
    found = read_lines(phd_exp(*words, "boxes=boxes.json").out)
    for row, (x, y, w, h), more in zip(found, boxes, known, strict=True):
        assert {key: row[key] for key in ("score", "category_id") if key in row} == more
        (alone,) = read_lines(phd_exp(*words, f"box={x},{y},{x + w},{y + h}").out)
        assert row["box"] == alone["box"]
        np.testing.assert_allclose(row["mode"], alone["mode"], rtol=1e-4)
    (of_category,) = read_lines(phd_exp(*words, "boxes=boxes.json", "object=0").out)
    assert of_category["box"] == found[0]["box"]


def test_a_margin_enlarges_the_view_of_each_box(phd_exp: Callable, run: RunFolder, photos: Path) -> None:
    """The view is that of the larger box, on the command line and from Python; the line has its own box."""
    words = ("predict", f"run={run.path}", f"image={photos / '0.png'}", "f=900")
    (wide,) = read_lines(phd_exp(*words, "box=20,30,60,70", "margin=1.5").out)
    (same,) = read_lines(phd_exp(*words, "box=10,20,70,80").out)
    assert wide.pop("box") == [20.0, 30.0, 60.0, 70.0]
    assert same.pop("box") == [10.0, 20.0, 70.0, 80.0]
    assert wide == same
    (whole,), (margin,) = (read_lines(phd_exp(*words, *more).out) for more in ((), ("margin=1.5",)))
    assert whole == margin
    predictor = package.load(run.path, margin=1.5)
    with Image.open(photos / "0.png") as image:
        array = np.asarray(image.convert("RGB"))
    K = intrinsics(900.0, 900.0, array.shape[1] / 2, array.shape[0] / 2)
    view = predictor.view(array, K, (20, 30, 60, 70))
    seen = view.camera.to_real(predictor.see(view).mode.numpy())
    np.testing.assert_allclose(seen, wide["mode"], rtol=1e-4, atol=1e-5)


def test_images_of_one_camera_are_predicted_as_single_ones(phd_exp: Callable, run: RunFolder, tmp_path: Path) -> None:
    """A folder needs no metadata.jsonl; images of several folders are named by theirs."""
    names = ["a.png", "b.JPG"]
    for folder in ("in", "more"):
        (tmp_path / folder).mkdir()
        for place, name in enumerate(names):
            Image.new("RGB", (64 + 8 * place, 64), (90 * place, 0, 50)).save(tmp_path / folder / name)
    (tmp_path / "in" / "notes.txt").write_text("no image")
    camera = ("f=300", "box=5,10,60,60")
    alone = [read_lines(phd_exp("predict", f"run={run.path}", f"image=in/{name}", *camera).out)[0] for name in names]
    assert [row["file_name"] for row in alone] == names
    for words in (("folder=in",), ("image=in/a.png,in/b.JPG",), ("image=in/a.png,more/b.JPG",)):
        outcome = phd_exp("predict", f"run={run.path}", *words, *camera)
        assert (outcome.status, outcome.err) == (0, "")
        for row, single in zip(read_lines(outcome.out), alone, strict=True):
            assert Path(row["file_name"]).name == single["file_name"]
            np.testing.assert_allclose(row["mode"], single["mode"], rtol=1e-4)
    assert [row["file_name"] for row in read_lines(outcome.out)] == ["in/a.png", "more/b.JPG"]


def test_every_line_has_its_own_picture(
    phd_exp: Callable, run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the images are called; where one cannot be drawn, the lines before it are whole."""
    titles: list[str] = []
    suptitle = pictures.Figure.suptitle

    def kept(self: pictures.Figure, text: str, **how: Any) -> Any:
        titles.append(text)
        return suptitle(self, text, **how)

    monkeypatch.setattr(pictures.Figure, "suptitle", kept)
    names = ["a.png", "a.jpg", "a.png", f"$x_${'l' * 230}\u4e2d.png"]
    (tmp_path / "in").mkdir()
    for name in names:
        Image.new("RGB", (64, 64)).save(tmp_path / "in" / name)
    write_metadata(tmp_path / "in", [{"file_name": name, "f": 400.5} for name in names])
    outcome = phd_exp("predict", f"run={run.path}", "folder=in", "out=drawn")
    assert outcome.status == 0, outcome.err
    rows = read_lines((tmp_path / "drawn" / "predictions.jsonl").read_text())
    assert [row["file_name"] for row in rows] == names
    files = {row["picture"] for row in rows}
    assert len(files) == len(names)
    refused = phd_exp("predict", f"run={run.path}", "folder=in", "out=in")
    assert (refused.status, "holds the images themselves" in refused.error) == (2, True)
    assert files == {file.name for file in (tmp_path / "drawn").glob("*.png")}
    first, second = titles[0].split("\n")
    assert first == "a.png, f = 400.5 px"
    assert second.startswith("mode (")
    assert "depth with 90 %: " in second
    (tmp_path / "in" / names[1]).write_bytes(b"no image")
    assert phd_exp("predict", f"run={run.path}", "folder=in", "out=broken").status == 1
    assert len(read_lines((tmp_path / "broken" / "predictions.jsonl").read_text())) == 1


@pytest.mark.parametrize(("precision", "panels"), [(1000.0, 3), (10.0, 2)])
def test_small_curves_have_a_close_up_and_the_box_a_frame(
    run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, precision: float, panels: int
) -> None:
    monkeypatch.setattr(pictures, "encoded", lambda figure, *_, **how: figure)
    (detection,) = detections_of([tmp_path / "a.png"], {"f": 900.0}, [{"box": [200, 150, 440, 330]}])
    image, predictor = Image.new("RGB", (640, 480)), package.load(run.path)
    view = predictor.view(image, *detection.optics(*image.size)[:1], detection.box(*image.size))
    eye = torch.eye(2, dtype=torch.float64)
    prediction = ProjectedHuber(0 * eye[:1], 4 * eye[0, :1], precision * eye[None], 50 * eye[0, :1])
    seen = PredictedViews(predictor, [view], torch.zeros(1, 7), torch.tensor([view.camera.f]).double())
    vars(seen)["predictions"] = prediction
    sighting = Sighting(detection, image, Answers([detection], seen), 0)
    line = sighting.line
    figure: Any = pictures.picture(sighting, line)
    first, second, *_ = axes = figure.axes
    assert len(axes) == panels
    np.testing.assert_allclose(first.patches[0].get_bbox().extents, [200, 150, 440, 330])
    low, high = line["depth_interval"]["90"]
    assert f"{low:.4g} to {high:.4g} m" in figure.get_suptitle()
    if panels == 3:
        widest = max(np.ptp(ring.get_xdata()) for ring in second.lines)
        assert widest > np.ptp(second.get_xlim()) / 3
        np.testing.assert_allclose(first.patches[1].get_bbox().intervalx, second.get_xlim())


def camera_file(path: Path, coefficients: list[float], **changes: Any) -> str:
    """A camera file for the first photograph, 90 x 120 pixels."""
    K = [300.0, 0.0, 49.5, 0.0, 310.0, 39.5, 0.0, 0.0, 1.0]
    values = {"width": 90, "height": 120, "K": K, "D": coefficients, "distortion_model": "plumb_bob"} | changes
    path.write_text(json.dumps(values))  # JSON is YAML
    return f"camera={path}"


def test_answers_and_curves_go_through_the_lens(
    phd_exp: Callable, run: RunFolder, photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without distortion as with fx, fy, cx, cy; else turned into the frame of the real camera."""
    marks: list[np.ndarray] = []
    plot = pictures.Axes.plot

    def kept(self: pictures.Axes, *points: Any, **how: Any) -> Any:
        marks.extend([np.array(points[:2])] if points[2:] == ("x",) else [])
        return plot(self, *points, **how)

    monkeypatch.setattr(pictures.Axes, "plot", kept)
    words = ("predict", f"run={run.path}", f"image={photos / '0.png'}", "box=5,10,60,70")
    (pinhole,) = read_lines(phd_exp(*words, "fx=300", "fy=310", "cx=50", "cy=40").out)
    (same,) = read_lines(phd_exp(*words, camera_file(tmp_path / "none.yaml", [0.0] * 5)).out)
    assert same == pinhole
    bent = camera_file(tmp_path / "bent.yaml", [-0.9, 0.4, 0.01, -0.02])
    assert phd_exp(*words, bent, "out=drawn").status == 0
    (row,) = read_lines((tmp_path / "drawn" / "predictions.jsonl").read_text())
    K, lens = intrinsics(300.0, 310.0, 50.0, 40.0), Lens((-0.9, 0.4, 0.01, -0.02))
    camera = VirtualCamera.of_box(K, (5.0, 10.0, 60.0, 70.0), float(SIDE), lens)
    predictor = package.load(run.path)
    with Image.open(photos / "0.png") as image:
        prediction = predictor.see(predictor.view(image.convert("RGB"), K, (5.0, 10.0, 60.0, 70.0), lens))
    np.testing.assert_allclose(row["mode"], camera.to_real(prediction.mode.numpy()), rtol=1e-4, atol=1e-5)
    R, covariance = camera.R, prediction.covariance_matrix.numpy()
    np.testing.assert_allclose(row["covariance"], R.T @ covariance @ R, rtol=1e-3, atol=1e-5)
    drawn = K[:2, 2] + np.diagonal(K)[:2] * lens.distort(np.array(row["mode"]))
    np.testing.assert_allclose(marks[0].ravel(), drawn, rtol=1e-4)
    for changes, said in (
        ({"coefficients": [-30.0, 0.0, 0.0, 0.0]}, "the lens folds over inside the image"),
        ({"coefficients": [0.0] * 5, "width": 180}, "is for images of 180 x 120 pixels; this image has 90 x 120"),
    ):
        refused = phd_exp(*words, camera_file(tmp_path / "bad.yaml", **changes))
        assert said in refused.error
        assert refused.out == ""


def test_from_python_arrays_of_any_size(run: RunFolder) -> None:
    predictor = package.load(run.path)
    images = np.random.default_rng(0).integers(0, 256, (3, 64, 64, 3), dtype=np.uint8)
    f = np.array([380.0, 400.0, 420.0])
    prediction = predictor(images, f=f)
    one = predictor(torch.from_numpy(images[2]), f=420.0)
    assert one.mode.shape == (3,)
    torch.testing.assert_close(one.mode, prediction.mode[2], rtol=1e-5, atol=1e-5)
    for same in (f.tolist(), torch.tensor(f, requires_grad=True), [torch.tensor(value) for value in f]):
        torch.testing.assert_close(predictor(images, f=same).mode, prediction.mode)
    for same in ([420.0], torch.tensor(420.0), torch.tensor([420.0]), np.float32(420.0)):
        torch.testing.assert_close(predictor(images[2], f=same).mode, one.mode)
    assert predictor(np.zeros((65, 9, 16, 3), dtype=np.uint8), f=40.0).mode.shape == (65, 3)
    for wrong in (images[0, :, :, 0], images.astype(np.float32), images[:, :, :, :2]):
        with pytest.raises(DatasetError, match=r"^images: got .* expected uint8 of shape"):
            predictor(wrong, f=400.0)
    for bad in (0.0, -1.0, float("nan"), [1.0, 2.0], "wide", None, [[1.0], 2.0]):
        with pytest.raises(DatasetError, match=r"^f: got"):
            predictor(images, f=bad)


def test_a_run_on_images_that_an_earlier_version_shrunk_is_refused(make: Callable[..., RunFolder]) -> None:
    rendered = make("data.sensor_size=64")
    assert package.load(rendered.path).side == 48
    rendered.constants_file.unlink()
    with pytest.raises(RunError, match="trained with images shrunk from 64 to 48 pixels by an earlier version"):
        package.load(rendered.path)


def test_an_unfinished_run_is_used_with_a_notice(phd_exp: Callable, spoiled: RunFolder, photos: Path) -> None:
    status_of(spoiled, state="interrupted")
    outcome = phd_exp("predict", f"run={spoiled.path}", f"image={photos / '0.png'}", "f=400")
    assert outcome.status == 0
    assert "the run is interrupted; its last checkpoint is used" in outcome.err
    assert len(read_lines(outcome.out)) == 1


LOADS = "phd_exp.load(sys.argv[1])\nassert not {'lightning', 'matplotlib', 'pyarrow', 'bpy'} & set(sys.modules)"


SLOW_TO_IMPORT = (
    "lightning hydra omegaconf wandb pandas torchvision torchmetrics numba rich scipy.optimize scipy.spatial "
    "scipy.stats sympy torch._dynamo torch._inductor matplotlib"
)


@pytest.mark.parametrize("then", ["", pytest.param(LOADS, marks=pytest.mark.slow)], ids=["import", "load"])
def test_the_import_does_not_wait_for_torch_nor_a_prediction_for_lightning(run: RunFolder, then: str) -> None:
    """That `inference` imports no Lightning is also a contract of `make lint`."""
    code = f"import sys, phd_exp\nassert 'torch' not in sys.modules\n{then}"
    done = subprocess.run([sys.executable, "-c", code, str(run.path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_prediction_imports_nothing_that_it_does_not_need(make: Callable[..., RunFolder], photos: Path) -> None:
    """With recorded held-out samples, which a prediction reads to say how familiar it is."""
    run = make(*NOWHERE)
    pq.write_table(pa.table(dict(table_of(100, 1))), run.held_out)
    code = (
        "import sys; from phd_exp.__main__ import main\n"
        "assert main(sys.argv[1:]) == 0\n"
        f"found = set({SLOW_TO_IMPORT!r}.split()) & set(sys.modules); assert not found, found"
    )
    words = ["predict", f"run={run.path}", f"image={photos / '0.png'}", "f=800"]
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "familiar" in json.loads(done.stdout)


def test_a_damaged_record_of_held_out_samples_is_noted(
    make: Callable[..., RunFolder], photos: Path, phd_exp: Callable
) -> None:
    run = make(*NOWHERE, "data.n_held_out=40")
    run.held_out.write_bytes(b"PAR1")
    outcome = phd_exp("predict", f"run={run.path}", f"image={photos / '0.png'}", "f=400")
    assert f": {run.held_out}: cannot be read (" in outcome.err

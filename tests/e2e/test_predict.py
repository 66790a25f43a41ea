"""Trained runs at work: predictions of files and arrays, their export, and what cannot be used."""

import json
import re
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from PIL import Image

import phd_exp as package
from phd_exp.__main__ import main
from phd_exp.distributions import PointEstimate, ProjectedHuber
from phd_exp.geometry import VirtualCamera, intrinsics
from phd_exp.inference import pictures
from phd_exp.records.errors import DatasetError
from phd_exp.records.runs import RunFolder
from tests.e2e.conftest import SIDE, trained
from tests.support.disks import small_disk

GUIDE = Path(__file__).parents[2] / "docs" / "guides" / "predict.md"


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Noise of two sizes with boxes anywhere."""
    folder = tmp_path_factory.mktemp("photos")
    draw = np.random.default_rng(0)
    for split, n in (("train", 8), ("test", 4)):
        (folder / split).mkdir()
        lines = []
        for index in range(n):
            width, height = (120, 90) if index % 2 else (90, 120)
            noise = draw.integers(0, 256, (height, width, 3), dtype=np.uint8)
            Image.fromarray(noise).save(folder / split / f"{index}.png")
            camera = {
                "fx": 300.0,
                "fy": 310.0,
                "cx": 50.0,
                "cy": 40.0,
                "box": [5 + index, 10, 60, 70 + index],
            }
            position = {"x": 0.01 * index, "y": -0.02, "z": 3.0 + 0.1 * index}
            lines.append(json.dumps({"file_name": f"{index}.png"} | camera | position) + "\n")
        (folder / split / "metadata.jsonl").write_text("".join(lines))
    return folder


def own(runs: Path, photos: Path, *arguments: str) -> RunFolder:
    few = ("preset=smoke", "data=folder", f"data.folder={photos}", "data.batch_size=4", "trainer.threads=1")
    return trained(runs, *few, "trainer.progress_bar=false", *arguments)


@pytest.fixture(scope="module")
def own_run(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return own(tmp_path_factory.mktemp("own"), photos)


@pytest.fixture(scope="module")
def baseline(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return own(tmp_path_factory.mktemp("baseline"), photos, "model=mae_constf")


@pytest.fixture
def spoiled(run: RunFolder, tmp_path: Path) -> RunFolder:
    """A copy of the run, to be changed."""
    return RunFolder(shutil.copytree(run.path, tmp_path / "spoiled"))


def lines(out: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in out.splitlines()]


def stacked(rows: list[dict[str, Any]], key: str) -> np.ndarray:
    return np.array([row[key] for row in rows])


def columns(table: pd.DataFrame, prefix: str) -> np.ndarray:
    return table[[f"{prefix}{axis}" for axis in "xyz"]].to_numpy()


def cameras(photos: Path) -> Iterator[VirtualCamera]:
    for text in (photos / "test" / "metadata.jsonl").read_text().splitlines():
        line = json.loads(text)
        K = intrinsics(*(line[name] for name in ("fx", "fy", "cx", "cy")))
        yield VirtualCamera.of_box(K, tuple(map(float, line["box"])), float(SIDE))  # type: ignore[arg-type]


def test_the_test_images_of_a_rendered_set_are_predicted_as_recorded(
    phd_exp: Callable, run: RunFolder, renders: Path
) -> None:
    outcome = phd_exp("predict", f"run={run.path}", f"folder={renders / 'default' / 'test'}")
    assert (outcome.status, outcome.err) == (0, "")
    table = pd.read_parquet(run.predictions)
    rows = lines(outcome.out)[: len(table)]
    assert [row["file_name"] for row in rows] == table["file_name"].tolist()
    for key, prefix in (("mode", "mode_"), ("mean", "mean_")):
        np.testing.assert_allclose(stacked(rows, key), columns(table, prefix), rtol=1e-5, atol=1e-5)
    for key, column in (("median_depth", "median_z"), ("nll", "nll"), ("credible_level", "level")):
        np.testing.assert_allclose(stacked(rows, key), table[column], rtol=1e-5, atol=1e-5)
    for row in rows:
        (a, d), (b, e), (c, g) = (row["depth_interval"][level] for level in ("99", "90", "50"))
        assert a < b < c < row["median_depth"] < g < e < d
        assert np.linalg.eigvalsh(row["covariance"]).min() > 0
        assert row["uncertainty"] == "as trained"


def test_own_images_are_predicted_as_recorded_and_turned_back(
    phd_exp: Callable, own_run: RunFolder, photos: Path
) -> None:
    outcome = phd_exp("predict", f"run={own_run.path}", f"folder={photos / 'test'}")
    assert (outcome.status, outcome.err) == (0, "")
    rows, table = lines(outcome.out), pd.read_parquet(own_run.predictions)
    for key, prefix in (("mode", "mode_"), ("mean", "mean_")):
        pairs = zip(cameras(photos), columns(table, prefix), strict=True)
        expected = [camera.to_real(row) for camera, row in pairs]
        np.testing.assert_allclose(stacked(rows, key), expected, rtol=1e-5, atol=1e-5)
    for key in ("depth_error_mm", "projected_error_mm"):
        np.testing.assert_allclose(stacked(rows, key), table[key], rtol=1e-3, atol=1e-2)
    np.testing.assert_allclose(stacked(rows, "nll"), table["nll"], rtol=1e-5, atol=1e-5)


def test_depth_of_a_crop_is_that_along_the_axis_of_the_real_camera(
    phd_exp: Callable, own_run: RunFolder, photos: Path
) -> None:
    outcome = phd_exp("predict", f"run={own_run.path}", f"folder={photos / 'test'}")
    row, camera = lines(outcome.out)[0], next(cameras(photos))
    predictor = package.load(own_run.path)
    image = np.asarray(Image.open(photos / "test" / "0.png"))
    view = predictor.view(image, camera.K, (5, 10, 60, 70))
    prediction = predictor.see(view)
    assert isinstance(prediction, ProjectedHuber)
    n = 100_000
    samples = prediction.rsample((n,), torch.Generator().manual_seed(0)).double().numpy()
    real = view.camera.to_real(samples)
    for level, (low, high) in row["depth_interval"].items():
        inside = ((low < real[:, 2]) & (real[:, 2] < high)).mean()
        share = int(level) / 100
        assert abs(inside - share) < 4 * np.sqrt(share * (1 - share) / n)
    assert abs((real[:, 2] < row["median_depth"]).mean() - 0.5) < 4 * np.sqrt(0.25 / n)
    scale = np.sqrt(np.diag(row["covariance"]))
    off = (np.cov(real.T) - row["covariance"]) / np.outer(scale, scale)
    assert np.abs(off).max() < 0.1


def test_a_baseline_says_that_it_knows_no_uncertainty(
    phd_exp: Callable, baseline: RunFolder, photos: Path, tmp_path: Path
) -> None:
    outcome = phd_exp("predict", f"run={baseline.path}", f"folder={photos / 'test'}", "out=drawn")
    assert outcome.status == 0, outcome.err
    rows = lines((tmp_path / "drawn" / "predictions.jsonl").read_text())
    errors = {"projected_error_mm", "depth_error_mm"}
    said = {"file_name", "box", "position", "uncertainty", "out_of_field", "picture"}
    assert rows[0].keys() == said | errors
    assert rows[0]["uncertainty"].startswith("none")
    pairs = zip(cameras(photos), columns(pd.read_parquet(baseline.predictions), "mode_"), strict=True)
    expected = [camera.to_real(row) for camera, row in pairs]
    np.testing.assert_allclose(stacked(rows, "position"), expected, rtol=1e-5, atol=1e-5)
    refused = phd_exp("predict", f"run={baseline.path}", f"folder={photos / 'test'}", "recalibrate=true")
    assert refused.status == 1
    assert "nothing to recalibrate" in refused.err


def test_one_image_is_the_line_of_a_folder_and_is_drawn(
    phd_exp: Callable, own_run: RunFolder, photos: Path, tmp_path: Path
) -> None:
    camera = ("fx=300", "fy=310", "cx=50", "cy=40", "box=5,10,60,70")
    image = f"image={photos / 'test' / '0.png'}"
    outcome = phd_exp("predict", f"run={own_run.path}", image, *camera, "out=drawn")
    assert (outcome.status, outcome.out) == (0, "")
    (row,) = lines((tmp_path / "drawn" / "predictions.jsonl").read_text())
    there = lines(phd_exp("predict", f"run={own_run.path}", f"folder={photos / 'test'}").out)[0]
    assert row.keys() - {"picture"} <= there.keys()
    for key in ("mode", "covariance", "median_depth"):
        np.testing.assert_allclose(row[key], there[key], rtol=1e-5, atol=1e-6)
    with Image.open(tmp_path / "drawn" / row["picture"]) as picture:
        assert picture.format == "PNG"
        assert picture.width > 2 * picture.height * 0.9
    before = (photos / "test" / "0.png").read_bytes()
    lost = phd_exp("predict", f"run={own_run.path}", image, *camera, f"out={photos / 'test'}")
    assert lost.status == 1
    assert "holds the images themselves" in lost.err
    assert (photos / "test" / "0.png").read_bytes() == before


def test_every_line_has_a_picture_of_its_own(
    phd_exp: Callable, own_run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the images are called; where one cannot be drawn, the lines before it are whole."""
    titles: list[str] = []
    suptitle = pictures.Figure.suptitle
    monkeypatch.setattr(
        pictures.Figure,
        "suptitle",
        lambda self, text, **how: titles.append(text) or suptitle(self, text, **how),
    )
    names = ["a.png", "a.jpg", "a-2.png", "a.png", "$x_$.png", f"{'l' * 240}.png", "\u4e2d.png"]
    (tmp_path / "in").mkdir()
    for name in names:
        Image.new("RGB", (64, 64)).save(tmp_path / "in" / name)
    text = "".join(json.dumps({"file_name": name, "f": 400.5}) + "\n" for name in names)
    (tmp_path / "in" / "metadata.jsonl").write_text(text)
    outcome = phd_exp("predict", f"run={own_run.path}", "folder=in", "out=drawn")
    assert outcome.status == 0, outcome.err
    rows = lines((tmp_path / "drawn" / "predictions.jsonl").read_text())
    assert [row["file_name"] for row in rows] == names
    files = {row["picture"] for row in rows}
    assert len(files) == len(names)
    assert {file.name for file in (tmp_path / "drawn").iterdir()} == files | {"predictions.jsonl"}
    assert titles[0] == "a.png, f = 400.5 px"
    (tmp_path / "in" / names[2]).write_bytes(b"no image")
    assert phd_exp("predict", f"run={own_run.path}", "folder=in", "out=broken").status == 1
    assert len(lines((tmp_path / "broken" / "predictions.jsonl").read_text())) == 2


def test_a_full_disk_is_one_line_and_the_predictions_before_are_whole(
    phd_exp: Callable, own_run: RunFolder, photos: Path, tmp_path: Path
) -> None:
    with small_disk(tmp_path / "disk", 200) as disk:
        outcome = phd_exp("predict", f"run={own_run.path}", f"folder={photos / 'test'}", f"out={disk}/drawn")
        assert outcome.status == 1
        (line,) = outcome.err.splitlines()
        assert "No space left on device" in line
        rows = lines((disk / "drawn" / "predictions.jsonl").read_text())
        assert 1 < len(rows) <= 4
        assert all((disk / "drawn" / row["picture"]).exists() for row in rows[:-1])


def test_recalibration_changes_the_uncertainty_alone_and_says_so(
    phd_exp: Callable, run: RunFolder, renders: Path
) -> None:
    words = ("predict", f"run={run.path}", f"image={renders / 'default' / 'test' / '000000.png'}", "f=400")
    (before,) = lines(phd_exp(*words).out)
    (after,) = lines(phd_exp(*words, "recalibrate=true").out)
    assert after["mode"] == before["mode"]
    assert after["covariance"] != before["covariance"]
    assert after["uncertainty"].startswith("recalibrated: A / ")


def test_from_python_arrays_of_any_size(run: RunFolder, renders: Path) -> None:
    predictor = package.load(run.path)
    table = pd.read_parquet(run.predictions)
    files = [renders / "default" / "test" / name for name in table["file_name"]]
    images = np.stack([np.asarray(Image.open(file).convert("RGB")) for file in files])
    prediction = predictor(images, f=table["f"].to_numpy())
    assert isinstance(prediction, ProjectedHuber)
    np.testing.assert_allclose(prediction.mode.numpy(), columns(table, "mode_"), rtol=1e-5, atol=1e-5)
    one = predictor(torch.from_numpy(images[2]), f=float(table["f"][2]))
    assert one.mode.shape == (3,)
    torch.testing.assert_close(one.mode, prediction.mode[2], rtol=1e-5, atol=1e-5)
    f = table["f"]
    for same in (f.tolist(), torch.tensor(f, requires_grad=True), [torch.tensor(value) for value in f]):
        torch.testing.assert_close(predictor(images, f=same).mode, prediction.mode)
    for same in (float(f[2]), [f[2]], torch.tensor(f[2]), torch.tensor([f[2]]), np.float32(f[2])):
        torch.testing.assert_close(predictor(images[2], f=same).mode, one.mode)
    wide = predictor(np.zeros((2, 90, 160, 3), dtype=np.uint8), f=400.0)
    assert wide.mode.shape == (2, 3)
    for wrong in (images[0, :, :, 0], images.astype(np.float32), images[:, :, :, :2]):
        with pytest.raises(DatasetError, match=r"^images: got .* expected uint8 of shape"):
            predictor(wrong, f=400.0)
    for f in (0.0, -1.0, float("nan"), [1.0, 2.0], "wide", None, [[1.0], 2.0]):
        with pytest.raises(DatasetError, match=r"^f: got"):
            predictor(images, f=f)


@pytest.mark.slow
def test_how_well_a_run_knows_itself_stands_beside_its_predictions(
    phd_exp: Callable, own_run: RunFolder, baseline: RunFolder, photos: Path, tmp_path: Path
) -> None:
    folder = f"folder={photos / 'test'}"
    for out, words, panels in (("plain", (), 2), ("more", ("calibration=true",), 3)):
        assert phd_exp("predict", f"run={own_run.path}", folder, f"out={out}", *words).status == 0
        with Image.open(tmp_path / out / "1-0.png") as picture:
            assert picture.width == panels * 540
    refused = phd_exp("predict", f"run={baseline.path}", folder, "out=more", "calibration=true")
    assert refused.status == 1
    assert "final.json: no calibration curve of depth" in refused.err


def test_what_is_recalibrated_is_shown_with_its_own_calibration(
    phd_exp: Callable, run: RunFolder, renders: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[dict] = []
    monkeypatch.setattr(pictures, "draw_curve", lambda axes, name, curve: drawn.append(curve))
    asked = (
        f"run={run.path}",
        f"image={renders / 'default' / 'test' / '000000.png'}",
        "f=400",
        "calibration=true",
    )
    for words in (("out=trained",), ("out=fitted", "recalibrate=true")):
        assert phd_exp("predict", *asked, *words).status == 0
    trained, fitted = drawn
    temperature = package.load(run.path, recalibrate=True).temperature
    assert temperature is not None
    ratio = np.array(fitted["predicted"]) / trained["predicted"]
    assert ((ratio > 1) == (temperature.depth > 1)).all()
    assert np.abs(ratio - 1).max() > 0.01
    assert fitted["window"] == trained["window"]


def test_of_a_baseline_python_gets_points(baseline: RunFolder) -> None:
    prediction = package.load(baseline.path)(np.zeros((64, 64, 3), dtype=np.uint8), f=300.0)
    assert isinstance(prediction, PointEstimate)


MISTAKES = [
    (("image=good.png", "f=400", "folder=."), "predict: expected either image=FILE"),
    (("folder=.", "f=400"), "f: belongs to image=FILE"),
    (("folder=.",), "metadata.jsonl, line 2: expected either f, or fx and fy"),
    (("folder=dot",), "dot: cannot be read (Is a directory)"),
    (("folder=nowhere",), "nowhere/metadata.jsonl: cannot be read"),
    (("image=good.png", "f=400", "run=nowhere"), "run: given twice"),
    (("imag=good.png",), "imag: unknown key, did you mean 'image'?"),
    (("good.png",), "good.png: expected key=value"),
    (("image=good.png", "f=400", "out=good.png/x"), "good.png/x: cannot be written"),
    (
        ("image=good.png", "f=400", "calibration=true"),
        "calibration: is drawn into the pictures; expected out=",
    ),
]
"""Of this verb alone; what images, cameras and folders can have wrong stands in tests/bad_input."""


@pytest.mark.parametrize(("words", "said"), MISTAKES, ids=[" ".join(words) for words, _ in MISTAKES])
def test_a_mistake_is_one_line(
    phd_exp: Callable, run: RunFolder, tmp_path: Path, words: tuple[str, ...], said: str
) -> None:
    Image.new("RGB", (64, 64)).save(tmp_path / "good.png")
    (tmp_path / "dot").mkdir()
    (tmp_path / "dot" / "metadata.jsonl").write_text('{"file_name": ".", "f": 400}')
    good = json.dumps({"file_name": "good.png", "f": 400})
    (tmp_path / "metadata.jsonl").write_text(f"{good}\n{json.dumps({'file_name': 'good.png'})}\n")
    outcome = phd_exp("predict", f"run={run.path}", *words)
    assert (outcome.status, outcome.out) == (1, "")
    (line,) = outcome.err.splitlines()
    assert line.startswith("error: ")
    assert said in line


def diverge(folder: RunFolder) -> None:
    checkpoint = torch.load(folder.last_checkpoint, weights_only=True)
    checkpoint["state_dict"]["regressor.last.bias"][0] = torch.nan
    torch.save(checkpoint, folder.last_checkpoint)


SPOILED: list[tuple[Callable[[RunFolder], Any], str]] = [
    (lambda it: it.last_checkpoint.unlink(), "last.ckpt: missing; the run has not trained a whole epoch yet"),
    (lambda it: it.constants_file.unlink(), "trained with images shrunk from 64 to 48 pixels by an earlier version"),
    (diverge, "000000.png: the network returns numbers that are not finite; train the run again"),
]  # fmt: skip


@pytest.mark.parametrize(("spoil", "said"), SPOILED, ids=[said for _, said in SPOILED])
def test_a_folder_that_holds_no_usable_run_is_one_line(
    phd_exp: Callable, spoiled: RunFolder, renders: Path, spoil: Callable, said: str
) -> None:
    spoil(spoiled)
    image = f"image={renders / 'default' / 'test' / '000000.png'}"
    outcome = phd_exp("predict", f"run={spoiled.path}", image, "f=400")
    assert outcome.status == 1
    (line,) = outcome.err.splitlines()
    assert said in line


def test_an_unfinished_run_is_used_and_said_so(phd_exp: Callable, spoiled: RunFolder, renders: Path) -> None:
    status = spoiled.status()
    assert status is not None
    spoiled.write_status(status.model_copy(update={"state": "interrupted"}))
    outcome = phd_exp(
        "predict", f"run={spoiled.path}", f"image={renders / 'default' / 'test' / '000000.png'}", "f=400"
    )
    assert outcome.status == 0
    assert "the run is interrupted; its last checkpoint is used" in outcome.err
    assert len(lines(outcome.out)) == 1


def test_constants_of_own_images_come_from_the_record(own_run: RunFolder, tmp_path: Path) -> None:
    copy = RunFolder(shutil.copytree(own_run.path, tmp_path / "copy"))
    assert package.load(copy.path).depth.mu_z0 == copy.constants()["mu_z0"]
    copy.constants_file.unlink()
    with pytest.raises(package.inference.predictor.RunError, match=r"constants.json: missing"):
        package.load(copy.path)


def test_neither_the_import_waits_for_torch_nor_a_prediction_for_lightning(run: RunFolder) -> None:
    code = (
        "import sys, phd_exp\n"
        "assert 'torch' not in sys.modules\n"
        "phd_exp.load(sys.argv[1])\n"
        "assert not {'lightning', 'matplotlib', 'pyarrow', 'bpy'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(run.path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def exported(run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    for module in ("onnx", "onnxscript", "onnxruntime"):
        pytest.importorskip(module, reason="export needs `pip install 'phd_exp[export]'`")
    file = tmp_path_factory.mktemp("exported") / "network.onnx"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "jaxtyping.config.jaxtyping_disable", True
        )  # a checked shape would be fixed in the graph
        assert main(["export", f"run={run.path}", f"out={file}"]) == 0
    return file


@pytest.mark.slow
def test_the_lines_of_the_guide_deploy_it_without_torch(
    phd_exp: Callable, exported: Path, run: RunFolder, tmp_path: Path
) -> None:
    (indented,) = re.findall(
        r"\n\n((?:    .*\n|\n)*    import onnxruntime\n(?:    .*\n|\n)*)", GUIDE.read_text()
    )
    shutil.copy(exported, tmp_path / "network.onnx")
    draw = np.random.default_rng(1)
    coarse = Image.fromarray(draw.integers(0, 256, (6, 6, 3), dtype=np.uint8))
    coarse.resize((150, 150), Image.Resampling.BICUBIC).save(tmp_path / "photo.png")
    block = "import sys\nfor name in ('torch', 'phd_exp', 'onnx', 'scipy'): sys.modules[name] = None\n"
    tell = "import json\nprint(json.dumps([x[0].tolist() for x in (mode, mean, covariance, median, interval)]))\n"
    (tmp_path / "deployed.py").write_text(block + textwrap.dedent(indented) + tell)
    done = subprocess.run(
        [sys.executable, "-P", "-c", "import sys; sys.path.insert(0, '.'); exec(open('deployed.py').read())"],
        cwd=tmp_path, env={}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    (row,) = lines(phd_exp("predict", f"run={run.path}", "image=photo.png", "f=1550").out)
    row["depth_interval"] = list(row["depth_interval"].values())
    keys = ("mode", "mean", "covariance", "median_depth", "depth_interval")
    for key, here in zip(keys, json.loads(done.stdout.splitlines()[-1]), strict=True):
        size = np.abs(row[key]).max()
        assert np.abs(np.array(here) - row[key]).max() < 1e-5 * size


@pytest.mark.slow
def test_the_file_says_what_it_takes_and_returns(exported: Path) -> None:
    import onnxruntime

    session = onnxruntime.InferenceSession(exported)
    said = json.loads(session.get_modelmeta().custom_metadata_map["phd_exp"])
    names = [value.name for value in (*session.get_inputs(), *session.get_outputs())]
    assert {*names} <= said.keys()
    assert (said["side"], said["temperature"]) == (SIDE, None)


@pytest.mark.slow
def test_an_export_that_deviates_is_refused_and_leaves_no_file(
    phd_exp: Callable, exported: Path, run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from onnx import load_from_string

    from phd_exp.inference import onnx

    predictor = package.load(run.path, device="cpu")
    assert onnx.largest_deviation(predictor, exported.read_bytes()) < onnx.TOLERANCE
    other = package.load(run.path, device="cpu")
    with torch.no_grad():
        other.regressor.last.bias.add_(1e-3)
    assert onnx.largest_deviation(other, exported.read_bytes()) > onnx.TOLERANCE
    monkeypatch.setattr(onnx, "_exported", lambda _: load_from_string(exported.read_bytes()))
    monkeypatch.setattr(onnx, "largest_deviation", lambda *_: 2e-5)
    outcome = phd_exp("export", f"run={run.path}", "out=here.onnx")
    assert outcome.status == 1
    assert "here.onnx: not written: it deviates from torch by 2e-05" in outcome.err
    assert not (tmp_path / "here.onnx").exists()
    monkeypatch.setattr(onnx, "largest_deviation", lambda *_: 0)
    with small_disk(tmp_path / "disk", 300) as disk:
        outcome = phd_exp("export", f"run={run.path}", f"out={disk}/here.onnx")
        assert (outcome.status, list(disk.iterdir())) == (1, [])
        (line,) = outcome.err.splitlines()
        assert "No space left on device" in line


@pytest.mark.slow
def test_a_baseline_is_exported_too(
    phd_exp: Callable, baseline: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("jaxtyping.config.jaxtyping_disable", True)
    outcome = phd_exp("export", f"run={baseline.path}", "out=network.onnx")
    assert outcome.status == 0, outcome.err
    assert "largest relative deviation from torch over 64 images" in outcome.out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "run: missing; export takes run=, out=, recalibrate="),
        (("run=nowhere",), "nowhere: no run; expected a folder with config.yaml"),
        (("run=.", "out=."), "out=.: is a folder"),
    ],
)
def test_a_mistake_in_exporting_is_one_line(phd_exp: Callable, words: tuple[str, ...], said: str) -> None:
    pytest.importorskip("onnxruntime", reason="export needs `pip install 'phd_exp[export]'`")
    outcome = phd_exp("export", *words)
    assert outcome.status == 1
    (line,) = outcome.err.splitlines()
    assert line.startswith(f"error: {said}")

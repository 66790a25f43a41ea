"""A trained run at work: its recorded predictions come back, recalibrated, drawn and exported."""

import json
import re
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from PIL import Image

import phd_exp as package
from phd_exp.__main__ import main
from phd_exp.evaluation.predictions import fit_temperature
from phd_exp.inference import pictures
from phd_exp.records.runs import RunFolder
from tests.support.disks import small_disk
from tests.support.portable import require_portable
from tests.support.untrained import SIDE, read_lines, read_metadata, write_metadata

ALL = slice(None)
GUIDE = Path(__file__).parents[2] / "docs" / "guides" / "predict.md"


@pytest.fixture
def image(run: RunFolder, renders: Path) -> tuple[str, str]:
    """The words for one rendered image; the run has rendered it."""
    return f"image={renders / 'default' / 'test' / '000000.png'}", "f=400"


def test_the_test_images_of_a_rendered_set_are_predicted_as_recorded(
    phd_exp: Callable, run: RunFolder, renders: Path
) -> None:
    """On the command line and from Python."""
    outcome = phd_exp("predict", f"run={run.path}", f"folder={renders / 'default' / 'test'}")
    assert (outcome.status, outcome.err) == (0, "")
    table = pd.read_parquet(run.predictions)
    recorded = {name: table[[f"{name}_{axis}" for axis in "xyz"]].to_numpy() for name in ("mode", "mean")} | {
        "median_depth": table["median_z"],
        "nll": table["nll"],
        "credible_level": table["level"],
    }
    rows = read_lines(outcome.out)[: len(table)]
    assert [row["file_name"] for row in rows] == table["file_name"].tolist()
    for key, expected in recorded.items():
        np.testing.assert_allclose(np.array([row[key] for row in rows]), expected, rtol=1e-5, atol=1e-5)
    for row in rows:
        (a, d), (b, e), (c, g) = (row["depth_interval"][level] for level in ("99", "90", "50"))
        assert a < b < c < row["median_depth"] < g < e < d
        assert np.linalg.eigvalsh(row["covariance"]).min() > 0
        assert row["uncertainty"] == "as trained"
    files = [renders / "default" / "test" / name for name in table["file_name"]]
    images = np.stack([np.asarray(Image.open(file).convert("RGB")) for file in files])
    prediction = package.load(run.path)(images, f=table["f"].to_numpy())
    np.testing.assert_allclose(prediction.mode.numpy(), recorded["mode"], rtol=1e-5, atol=1e-5)


def test_labelled_images_calibrate_a_run(
    phd_exp: Callable, run: RunFolder, renders: Path, image: tuple[str, str], tmp_path: Path
) -> None:
    """Their temperatures are those that fit the recorded predictions of the same images."""
    shutil.copytree(run.path, mine := tmp_path / "mine")
    labelled = renders / "default" / "test"
    outcome = phd_exp("calibrate", f"run={mine}", f"folder={labelled}", "name=garden")
    assert outcome.status == 0
    assert re.search(r"as trained: depth error .* inside 50 %, .* inside 90 %\n  temperatures .*: A / ", outcome.out)
    table = pd.read_parquet(run.predictions)
    fitted = fit_temperature({name: table[name].to_numpy() for name in table if table[name].dtype == float}, ALL)
    predictor = package.load(mine).calibrated("garden")
    assert predictor.temperature.projected == pytest.approx(fitted.projected, rel=1e-3)
    assert predictor.temperature.depth == pytest.approx(fitted.depth, rel=1e-3)
    (line,) = read_lines(phd_exp("predict", f"run={mine}", *image, "calibration=garden").out)
    assert line["uncertainty"] == f"recalibrated: A / {fitted.projected:.4g}, a / {fitted.depth:.4g}"
    refused = phd_exp("predict", f"run={mine}", *image, "calibration=garden", "margin=1.2")
    assert "garden.parquet is of views with margin=1; got margin=1.2; expected the same" in refused.error
    outcome = phd_exp("calibrate", f"run={mine}", f"folder={labelled}", "name=garden", "margin=1.2")
    assert "calibration=garden margin=1.2 ..." in outcome.out
    assert phd_exp("predict", f"run={mine}", *image, "calibration=garden", "margin=1.2").status == 0
    lines = read_metadata(labelled)
    (wrong := tmp_path / "mm").mkdir()
    for one in lines:
        shutil.copy(labelled / one["file_name"], wrong)
    write_metadata(wrong, [one | {axis: 1000 * one[axis] for axis in "xyz"} for one in lines])
    outcome = phd_exp("calibrate", f"run={mine}", f"folder={wrong}")
    assert outcome.status == 1
    assert re.search(r"the position .* is so far away .*; if these are millimetres, divide them by 1000", outcome.err)


def test_recalibration_changes_the_uncertainty_alone_and_the_curve_in_the_picture(
    phd_exp: Callable, run: RunFolder, image: tuple[str, str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    drawn: list[dict] = []
    monkeypatch.setattr(pictures, "draw_curve", lambda axes, name, curve: drawn.append(curve))
    for words in (("out=trained",), ("out=fitted", "recalibrate=true")):
        assert phd_exp("predict", f"run={run.path}", *image, "curve=true", *words).status == 0
    before, after = (json.loads((tmp_path / out / "predictions.jsonl").read_text()) for out in ("trained", "fitted"))
    assert after["mode"] == before["mode"]
    assert after["covariance"] != before["covariance"]
    assert after["uncertainty"].startswith("recalibrated: A / ")
    trained, fitted = drawn
    temperature = package.load(run.path, recalibrate=True).temperature
    ratio = np.array(fitted["predicted"]) / trained["predicted"]
    assert ((ratio > 1) == (temperature.depth > 1)).all()
    assert np.abs(ratio - 1).max() > 0.01
    assert fitted["window"] == trained["window"]


@pytest.fixture(scope="module")
def exported(run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    for module in ("onnx", "onnxscript", "onnxruntime"):
        pytest.importorskip(module, reason="export needs `pip install 'phd_exp[export]'`")
    file = tmp_path_factory.mktemp("exported") / "network.onnx"
    with pytest.MonkeyPatch.context() as patch:
        # a checked shape would be fixed in the graph
        patch.setattr("jaxtyping.config.jaxtyping_disable", True)
        assert main(["export", f"run={run.path}", f"out={file}"]) == 0
        assert (
            main(["export", f"run={run.path}", f"out={file.with_name('photographs.onnx')}", "photographs=true"]) == 0
        )
    return file


@pytest.mark.slow
def test_the_lines_of_the_guide_deploy_it_without_torch(
    phd_exp: Callable, exported: Path, run: RunFolder, tmp_path: Path
) -> None:
    (indented,) = re.findall(r"\n\n((?:    .*\n|\n)*    import onnxruntime\n(?:    .*\n|\n)*)", GUIDE.read_text())
    shutil.copy(exported.with_name("photographs.onnx"), tmp_path / "network.onnx")
    draw = np.random.default_rng(1)
    coarse = Image.fromarray(draw.integers(0, 256, (6, 6, 3), dtype=np.uint8))
    coarse.resize((150, 150), Image.Resampling.BICUBIC).save(tmp_path / "photo.png")
    block = "import sys\nfor name in ('torch', 'phd_exp', 'onnx', 'scipy'): sys.modules[name] = None\n"
    tell = "import json\nprint(json.dumps([x.tolist() for x in (mean, covariance, interval)]))\n"
    (tmp_path / "deployed.py").write_text(block + textwrap.dedent(indented) + tell)
    done = subprocess.run(
        [sys.executable, "-P", "-c", "import sys; sys.path.insert(0, '.'); exec(open('deployed.py').read())"],
        cwd=tmp_path, env={}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    command = ("predict", f"run={run.path}", "image=photo.png", "f=1550")
    keys = ("mean", "covariance", "depth_interval")
    here = json.loads(done.stdout.splitlines()[-1])
    # off the middle of the photograph, depth is not the coordinate along the ray
    for number, (words, shared) in enumerate([("box=20,15,90,140", keys[:2]), ("box=0,0,150,150", keys)]):
        (row,) = read_lines(phd_exp(*command, words).out)
        row["depth_interval"] = list(row["depth_interval"].values())
        for key, values in zip(shared, here, strict=False):
            assert np.abs(np.array(values[number]) - row[key]).max() < 1e-4 * np.abs(row[key]).max()


@pytest.mark.slow
def test_the_exported_file_describes_its_inputs_and_outputs(exported: Path) -> None:
    import onnxruntime
    from onnx import load

    for file in (exported, exported.with_name("photographs.onnx")):
        require_portable(load(file))
        session = onnxruntime.InferenceSession(file)
        said = json.loads(session.get_modelmeta().custom_metadata_map["phd_exp"])
        names = [value.name for value in (*session.get_inputs(), *session.get_outputs())]
        assert {*names} <= said.keys()
        assert (said["side"], said["temperature"]) == (SIDE, None)
        assert said["precision"] == "float32"


@pytest.mark.slow
def test_an_export_that_deviates_is_refused_and_leaves_no_file(
    phd_exp: Callable, exported: Path, run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from onnx import load_from_string

    from phd_exp.inference import onnx
    from phd_exp.inference.deployed import OfImages

    predictor, other = (package.load(run.path, device="cpu") for _ in range(2))
    assert onnx.largest_deviation(OfImages(predictor), exported.read_bytes()) < onnx.TOLERANCE
    with torch.no_grad():
        other.network.networks[0].last.bias.add_(1e-3)
    assert onnx.largest_deviation(OfImages(other), exported.read_bytes()) > onnx.TOLERANCE
    monkeypatch.setattr(onnx, "graph", lambda _: load_from_string(exported.read_bytes()))
    monkeypatch.setattr(onnx, "largest_deviation", lambda *_: 2e-5)
    outcome = phd_exp("export", f"run={run.path}", "out=here.onnx")
    assert outcome.status == 1
    assert "here.onnx: not written: it deviates from torch by 2e-05" in outcome.err
    assert not (tmp_path / "here.onnx").exists()
    monkeypatch.setattr(onnx, "largest_deviation", lambda *_: 0)
    with small_disk(tmp_path / "disk", 300) as disk:
        outcome = phd_exp("export", f"run={run.path}", f"out={disk}/here.onnx")
        assert (outcome.status, list(disk.iterdir())) == (1, [])
        assert "No space left on device" in outcome.error

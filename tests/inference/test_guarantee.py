"""Guaranteed regions of `predict`, `fuse` and `export`: what they write, and what they refuse."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from PIL import Image
from scipy import stats

import phd_exp as package
from phd_exp.distributions.regions import PRECISIONS
from phd_exp.distributions.rounded import depth_law
from phd_exp.evaluation.conformal import fused_guarantee
from phd_exp.inference import pictures
from phd_exp.records.errors import ConfigError, RunError
from phd_exp.records.runs import RunFolder
from tests.evaluation.test_conformal import table_of
from tests.support.several import write_views
from tests.support.untrained import NOWHERE, read_lines, read_metadata, virtual_cameras, write_metadata, write_photos

POSES = [[0.0, 0.0, 0.0], [0.05, 0.0, 0.0]]


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Crops of two cameras that stand close together, in two scenes."""
    folder = tmp_path_factory.mktemp("photos") / "test"
    write_photos(folder, 4)
    lines = read_metadata(folder)
    for row, line in enumerate(lines):
        line |= {"scene": row // 2, "pose": {"rotation": [1, 0, 0, 0], "translation": POSES[row % 2]}}
        for key in "xyz":
            del line[key]
    write_metadata(folder, lines)
    return folder


@pytest.fixture(scope="module")
def run(make: Callable[..., RunFolder]) -> RunFolder:
    """An untrained run with records of held-out samples and of scenes."""
    run = make(*NOWHERE)
    pd.DataFrame(table_of(400, 1, overconfidence=1.3)).to_parquet(run.held_out)
    write_views(run.views, n=60)
    return run


@pytest.mark.parametrize("groups", [None, pytest.param("truncation", marks=pytest.mark.slow)])
def test_regions_are_those_of_the_guarantee_along_the_real_axis(
    phd_exp: Callable, run: RunFolder, photos: Path, groups: str | None
) -> None:
    words = [f"groups={groups}"] if groups else []
    outcome = phd_exp("predict", f"run={run.path}", f"folder={photos}", "coverage=0.9", *words)
    assert outcome.status == 0, outcome.err
    plain = read_lines(phd_exp("predict", f"run={run.path}", f"folder={photos}").out)
    predictor = package.load(run.path)
    found = predictor.guarantee(0.9, groups)  # type: ignore[arg-type]
    for row, same, camera in zip(read_lines(outcome.out), plain, virtual_cameras(photos), strict=True):
        region = row.pop("region")
        assert row == same
        prediction = predictor.see(
            predictor.view(np.asarray(Image.open(photos / row["file_name"])), camera.K, row["box"])
        )
        facts = found.region(prediction, camera.f / camera.S)[1]
        assert facts.items() <= region.items()
        xyz = prediction.rsample((20_000,), torch.Generator().manual_seed(0))
        inside = (prediction.level(xyz) <= facts["level"]).numpy()
        depth = camera.to_real(xyz.double().numpy())[inside, 2]
        low, high = region["depth_interval"]
        assert low - 1e-4 * (high - low) <= depth.min() <= depth.max() <= high + 1e-4 * (high - low)
        assert depth.max() - depth.min() > 0.7 * (high - low)
        assert region["volume"] > 0


def test_recalibrated_predictions_have_their_own_guarantee(phd_exp: Callable, run: RunFolder, photos: Path) -> None:
    words = ("predict", f"run={run.path}", f"folder={photos}", "coverage=0.9")
    before, after = (read_lines(phd_exp(*words, *more).out)[0]["region"] for more in ([], ["recalibrate=true"]))
    assert after["level"] < before["level"]
    assert after["held_out_samples"] == before["held_out_samples"] == 200


def test_pictures_have_the_outline(
    phd_exp: Callable, run: RunFolder, photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    figures: list[Any] = []
    encoded = pictures.encoded
    monkeypatch.setattr(
        pictures, "encoded", lambda figure, *how, **more: figures.append(figure) or encoded(figure, *how, **more)
    )
    words = ("predict", f"run={run.path}", f"folder={photos}", "out=drawn", "coverage=0.95")
    assert phd_exp(*words).status == 0
    assert len(figures) == 4
    for figure in figures:
        image, above = figure.axes
        assert "95 % guaranteed" in [text.get_text() for text in above.get_legend().get_texts()]
        for axes in (image, above):
            (outline,) = (line for line in axes.lines if line.get_linestyle() == "--")
            assert len(outline.get_xydata()) > 50


def test_fused_regions_are_ellipsoids_that_recorded_scenes_guarantee(
    phd_exp: Callable, run: RunFolder, photos: Path
) -> None:
    outcome = phd_exp("fuse", f"run={run.path}", f"folder={photos}", "coverage=0.9")
    assert outcome.status == 0, outcome.err
    alone = {
        line["file_name"]: line["familiar"]
        for line in read_lines(phd_exp("predict", f"run={run.path}", f"folder={photos}").out)
    }
    for row in read_lines(outcome.out):
        assert row["familiar"] == [alone[name] for name in row["file_names"]]
        region = row["region"]
        facts = fused_guarantee(run.views, 2, 0.9, None)
        assert facts.items() <= region.items()
        assert facts["held_out_samples"] == 30
        root = np.linalg.cholesky(np.array(row["covariance"]))
        sphere = stats.uniform_direction(3, seed=0).rvs(20_000)
        border = row["mean"] + np.sqrt(facts["squared_mahalanobis"]) * sphere @ root.T
        np.testing.assert_allclose(
            np.transpose(region["extent"]), [border.min(0), border.max(0)], rtol=1e-3, atol=1e-3
        )
        volume = 4 / 3 * np.pi * facts["squared_mahalanobis"] ** 1.5 * np.prod(np.diag(root))
        assert region["volume"] == pytest.approx(volume, rel=1e-5)


@pytest.mark.parametrize("rounding", [0.0, 2.0])
def test_the_exported_file_has_the_threshold_and_the_energy_of_its_regions(
    phd_exp: Callable, make: Callable, run: RunFolder, monkeypatch: pytest.MonkeyPatch, rounding: float
) -> None:
    models = pytest.importorskip("onnx", reason="export needs `pip install 'phd_exp[export]'`")
    pytest.importorskip("onnxruntime")
    from phd_exp.inference import onnx

    if rounding:
        run = make(*NOWHERE, "model=rounded_t")
        table = table_of(400, 1, overconfidence=1.3) | {"rounding": np.full(400, rounding)}
        pd.DataFrame(table).to_parquet(run.held_out)
    monkeypatch.setattr(onnx, "graph", lambda predictor: models.ModelProto(ir_version=8))
    monkeypatch.setattr(onnx, "largest_deviation", lambda *_: 0.0)
    for words in ((), ("recalibrate=true",)):
        assert phd_exp("export", f"run={run.path}", "out=network.onnx", "coverage=0.9", *words).status == 0
        (entry,) = models.load("network.onnx").metadata_props
        region = json.loads(entry.value)["region"]
        predictor = package.load(run.path)
        found = (predictor.recalibrated(guarantees=True) if words else predictor).guarantee(0.9)
        assert (region["coverage"], region["level"], region["held_out_samples"]) == (0.9, found.levels[0], 200)
        W, a = (torch.tensor(region[name], dtype=torch.float64) for name in "Wa")
        assert region["rounding"] == rounding
        found_level = depth_law(a.log(), rounding).level(W)
        torch.testing.assert_close(found_level, torch.full_like(PRECISIONS, region["level"]))
    assert phd_exp("export", f"run={run.path}", "out=network.onnx").status == 0
    assert "region" not in json.loads(models.load("network.onnx").metadata_props[0].value)


def test_temperatures_that_do_not_fit_name_the_run(make: Callable) -> None:
    run = make(*NOWHERE)
    pd.DataFrame(table_of(40, 1) | {"a": np.full(40, -1.0)}).to_parquet(run.held_out)
    with pytest.raises(RunError, match=rf"^{run.path}: predictions: parameters are of no distribution"):
        package.load(run.path, recalibrate=True)


def test_samples_that_chose_temperatures_guarantee_nothing(run: RunFolder) -> None:
    predictor = package.load(run.path, recalibrate=True)
    every, second = predictor.temperature, predictor.recalibrated(guarantees=True).temperature
    assert every != second
    with pytest.raises(ConfigError, match=r"^guarantee: all samples .* recalibrated\(guarantees=True\)"):
        predictor.guarantee(0.9)


ONE = ("predict", "image=photo.png", "f=100")
TOO_FEW = [
    ((*ONE, "coverage=0.999"), "coverage: got 0.999; needs at least 999 held-out samples, every"),
    ((*ONE, "coverage=0.99", "groups=spread"), "needs at least 99 held-out samples of each group"),
    (("fuse", "folder=test", "coverage=0.99"), "needs at least 99 scenes, every second of"),
]


@pytest.mark.parametrize(("words", "said"), TOO_FEW, ids=[said for _, said in TOO_FEW])
def test_too_few_samples_are_one_line(
    phd_exp: Callable, run: RunFolder, photos: Path, tmp_path: Path, words: tuple[str, ...], said: str
) -> None:
    """tests/bad_input has the other mistakes."""
    Image.new("RGB", (64, 64)).save(tmp_path / "photo.png")
    (tmp_path / "test").symlink_to(photos)
    assert said in phd_exp(words[0], f"run={run.path}", *words[1:]).error

"""Own images from files to a run record, and back by `predict`."""

import importlib.util
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from phd_exp.data.folder import FolderSource
from phd_exp.records.own_images import DetectionFolder, fingerprint
from tests.support.recorded import only_run, status_of
from tests.support.untrained import NARROW, read_lines, virtual_cameras, write_photos

N_TRAIN, N_TEST = 8, 2


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("own") / "photos"
    folder.mkdir()
    write_photos(folder / "train", N_TRAIN)
    write_photos(folder / "test", N_TEST)
    return folder


@pytest.fixture
def train(phd_exp: Callable, photos: Path, monkeypatch: pytest.MonkeyPatch) -> Callable:
    """A run on the photographs, on a machine without Blender."""
    real = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *more: None if name == "bpy" else real(name, *more))
    quick = ("preset=smoke", "data=folder", "data.batch_size=4", "trainer.progress_bar=false", "trainer.threads=1")
    return lambda *words: phd_exp(*quick, *NARROW, "logger=none", "data.name=mycams", f"data.folder={photos}", *words)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("runs")


@pytest.mark.parametrize("model", ["probabilistic", pytest.param("mae_constf", marks=pytest.mark.slow)])
def test_a_run_on_own_images_leaves_a_whole_record_and_predicts_the_same(
    train: Callable, phd_exp: Callable, photos: Path, runs: Path, model: str
) -> None:
    outcome = train(f"model={model}", f"runs={runs / model}")
    assert outcome.status == 0, outcome.err
    run = only_run(runs / model)
    assert run.path.relative_to(runs / model).as_posix().startswith(f"smoke/mycams/{model}/seed0-")
    results = run.results()
    assert (results["data"], results["n_train"], results["n_test"]) == ("mycams", N_TRAIN, N_TEST)
    assert np.isfinite(results["test/depth_error_mm"])
    assert status_of(run).data_manifest == fingerprint(photos / "train", photos / "test")
    table = pd.read_parquet(run.predictions)
    assert {"file_name", "f", "S", "x", "y", "z"} <= set(table.columns)
    assert not {"scale", "visibility"} & set(table.columns)
    (crop, *_) = FolderSource(DetectionFolder(photos), None, 0, None, 64).crops["test"]
    np.testing.assert_allclose(table.loc[0, ["x", "y", "z"]].astype(float), crop.xyz, rtol=1e-6)
    assert table.loc[0, "f"] == crop.camera.f
    rows = read_lines(phd_exp("predict", f"run={run.path}", f"folder={photos / 'test'}").out)
    modes = table[["mode_x", "mode_y", "mode_z"]].to_numpy()
    for row, mode, camera in zip(rows, modes, virtual_cameras(photos / "test", 64), strict=True):
        place = row["mode" if model == "probabilistic" else "position"]
        np.testing.assert_allclose(place, camera.to_real(mode), rtol=1e-5, atol=1e-5)
    for key in ("depth_error_mm", "projected_error_mm"):
        np.testing.assert_allclose([row[key] for row in rows], table[key], rtol=1e-3, atol=1e-2)


def test_a_run_on_other_data_is_never_reused(train: Callable, photos: Path, runs: Path, tmp_path: Path) -> None:
    """Neither with other metadata of the same name, nor from another folder."""
    assert train(f"runs={runs / 'probabilistic'}").status == 0
    shutil.copytree(runs / "probabilistic", tmp_path / "runs")
    assert "finished already" in train().out
    metadata = photos / "train" / "metadata.jsonl"
    before = metadata.read_text()
    metadata.write_text(before + "\n")
    outcome = train()
    metadata.write_text(before)
    assert "as it was before its annotations changed" in outcome.error
    run = only_run(tmp_path / "runs")
    config = run.config()
    assert config["data"]["folder"] == str(photos)
    config["data"]["folder"] = "elsewhere"
    run.write_config(config)
    assert f"data.folder=elsewhere, but data.folder={photos} is asked for" in train().error

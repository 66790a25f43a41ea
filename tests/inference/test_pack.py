"""Packed runs: equal predictions, equal bytes for equal runs, and a card that repeats the record.

Archives of an attacker are in tests/bad_input/table.py.
"""

import gc
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

import phd_exp as package
from phd_exp.records.packed import NAMES
from phd_exp.records.runs import RunFolder
from tests.evaluation.test_conformal import table_of
from tests.support.recorded import status_of
from tests.support.untrained import SMALL, untrained, write_photos


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photos") / "test"
    write_photos(folder, 2)
    return folder


@pytest.fixture
def run(composed: Callable, tmp_path: Path) -> RunFolder:
    """A run with all tables, a large checkpoint, and files that stay at home."""
    run = untrained(tmp_path / "secret-place" / "run", composed(*SMALL, "data=folder", "data.folder=secret-photos"))
    # parts of the training alone are neither built nor imported
    run.write_config(run.config() | {"loss": {"_target_": "nobodys.loss"}})
    run.write_results({"test/nll": -1.5, "epochs": 3, "device": "cpu|<b>`![x](https://server/x.png)"})
    run.labelled("mine").parent.mkdir()
    draw = np.random.default_rng(0)
    scores = {"level": draw.random(100), "depth_error_mm": draw.exponential(80, 100)}
    for file in (run.predictions, run.held_out, run.labelled("mine")):
        pq.write_table(pa.table({**table_of(100, 1), **scores}), file)
    state = torch.load(run.last_checkpoint)
    torch.save(state | {"optimizer_states": [torch.zeros(10**6)]}, run.last_checkpoint)
    (run.path / "wandb").mkdir()
    (run.path / "wandb" / "key.txt").write_text("secret")
    return run


def predict(phd_exp: Callable, run: Path, photos: Path, *words: str) -> str:
    outcome = phd_exp("predict", f"run={run}", f"folder={photos}", *words)
    assert outcome.status == 0, outcome.err
    return outcome.out


def test_a_packed_run_predicts_as_its_folder(phd_exp: Callable, run: RunFolder, photos: Path, tmp_path: Path) -> None:
    file = tmp_path / "run.zip"
    assert phd_exp("pack", f"run={run.path}", f"out={file}").status == 0
    assert file.stat().st_size < run.last_checkpoint.stat().st_size
    for words in ((), ("recalibrate=true", "coverage=0.8"), ("calibration=mine",)):
        assert predict(phd_exp, file, photos, *words) == predict(phd_exp, run.path, photos, *words)
    with ZipFile(file) as archive:
        assert archive.testzip() is None
        assert all(NAMES.fullmatch(name) for name in archive.namelist())
        assert not any(b"secret" in archive.read(name) for name in archive.namelist() if name != "config.yaml")


def test_the_example_of_the_package_contains_the_truth(
    phd_exp: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # nothing of its name is there
    outcome = phd_exp("predict", "run=cylinder", "image=cylinder.png", "f=1562.5")
    low, high = json.loads(outcome.out)["depth_interval"]["90"]
    assert low < 4.381 < high < 1.3 * low


def test_the_files_are_there_as_long_as_the_predictor(phd_exp: Callable, run: RunFolder, tmp_path: Path) -> None:
    assert phd_exp("pack", f"run={run.path}").status == 0
    predictor = package.load(run.path / "run.zip")
    place = predictor.folders[0].path
    assert predictor.held_out()
    assert place.parent.stat().st_mode & 0o077 == 0
    del predictor
    gc.collect()
    assert not place.parent.exists()


def test_equal_runs_have_equal_bytes(phd_exp: Callable, run: RunFolder, tmp_path: Path) -> None:
    shutil.copytree(run.path, tmp_path / "copy")
    files = [tmp_path / "a.zip", tmp_path / "b.zip"]
    for path, file in zip((run.path, tmp_path / "copy"), files, strict=True):
        assert phd_exp("pack", f"run={path}", f"out={file}").status == 0
    assert files[0].read_bytes() == files[1].read_bytes()


def test_the_card_repeats_the_record(phd_exp: Callable, run: RunFolder, tmp_path: Path) -> None:
    assert phd_exp("pack", f"run={run.path}", f"out={tmp_path / 'run.zip'}", "license=CC-BY-4.0").status == 0
    with ZipFile(tmp_path / "run.zip") as archive:
        card = archive.read("README.md").decode()
    table = pq.read_table(run.predictions)
    rows = dict(re.findall(r"^\| (.+?) \| (.+?) \|$", card, re.MULTILINE))
    inside = rows["truths inside the 90 % credible region, %"].split(" ± ")[0]
    assert float(inside) == pytest.approx(100 * (table["level"].to_numpy() <= 0.9).mean(), abs=0.05)
    error, half = map(float, rows["depth error, mm"].split(" ± "))
    errors = table["depth_error_mm"].to_numpy()
    assert error == pytest.approx(errors.mean(), rel=1e-3)
    assert half == pytest.approx(1.96 * errors.std() / 10, rel=0.05)
    assert card.startswith("---\nlicense: cc-by-4.0\n")
    assert (rows["on 100 test images"], rows["epochs"]) == ("mean ± 95 % interval", "3")
    assert rows["device"].startswith("cpu/(b>`!")
    assert "![x](" not in card
    assert "secret" not in card


def test_a_link_is_not_packed(phd_exp: Callable, run: RunFolder, tmp_path: Path) -> None:
    """It may lead to a file of the user, who would share it."""
    secret = tmp_path / "secret.parquet"
    run.held_out.rename(secret)
    run.held_out.symlink_to(secret)
    outcome = phd_exp("pack", f"run={run.path}", f"out={tmp_path / 'run.zip'}")
    assert outcome.error.startswith(f"{run.held_out}: is a link")
    run.held_out.unlink()
    run.labelled("mine").parent.rename(tmp_path / "labels")
    (run.path / "labelled").symlink_to(tmp_path / "labels")
    outcome = phd_exp("pack", f"run={run.path}", f"out={tmp_path / 'run.zip'}")
    assert outcome.error.startswith(f"{run.labelled('mine')}: is a link")
    assert not (tmp_path / "run.zip").exists()


def test_what_cannot_be_packed_or_recorded(phd_exp: Callable, run: RunFolder, photos: Path, tmp_path: Path) -> None:
    assert phd_exp("pack", f"run={run.path}").status == 0
    file = run.path / "run.zip"
    assert phd_exp("pack", f"run={file}").error == f"{file}: expected the folder of a finished run"
    calibrate = phd_exp("calibrate", f"run={file}", f"folder={photos}")
    assert calibrate.error.startswith(f"run={file}: a packed run records nothing")
    eight = phd_exp("predict", f"run={file}", f"folder={photos}", "views=8", "recalibrate=true")
    assert "/run.zip/eight_views_held_out.parquet: missing; " in eight.error
    assert phd_exp("pack", f"run={run.path}", "license=a b").error.startswith("license: got 'a b'; ")
    status_of(run, state="interrupted")
    assert phd_exp("pack", f"run={run.path}").error == f"{run.path}: expected the folder of a finished run"
    assert phd_exp("pack", "run=nowhere").error == "nowhere: expected the folder of a finished run"

"""Ensembles of runs and of symmetric views: exact laws, and one line for runs that do not fit together."""

import json
import shutil
from collections.abc import Callable
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import phd_exp as package
from phd_exp.data.batches import Batch
from phd_exp.distributions import ProjectedHuber
from phd_exp.geometry.motion import EIGHT, turned
from phd_exp.records.runs import RunFolder
from phd_exp.training.predictions import columns, write_parquet
from tests.support.recorded import status_of
from tests.support.untrained import SIDE, SMALL, read_lines, untrained, write_photos

OWN = ("data=folder", "data.folder=photos")
N = 48  # held-out samples


@pytest.fixture(scope="module")
def first(composed: Callable, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with photos and a run, which nobody changes."""
    place = tmp_path_factory.mktemp("ensembles")
    write_photos(place / "photos", 3)
    folder = untrained(place / "run", composed(*SMALL, *OWN))
    record(folder, N, "")
    return place


@pytest.fixture
def make(first: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable:
    """A copy of the run in runs/NAME with other values of its configuration, its weights multiplied by a factor."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photos").symlink_to(first / "photos")

    def made(name: str, factor: float = 1.0, held_out: str | None = None, **values: Any) -> RunFolder:
        folder = RunFolder(Path(shutil.copytree(first / "run", Path("runs") / name)))
        config = folder.config()
        for key, value in values.items():
            *sections, leaf = key.split("__")
            reduce(getitem, sections, config)[leaf] = value
        folder.write_config(config)
        if factor != 1:
            content = torch.load(folder.last_checkpoint, weights_only=True)
            content["state_dict"]["regressor.last.weight"].mul_(factor)
            torch.save(content, folder.last_checkpoint)
            record(folder, N, "")
        return folder

    return made


def record(folder: RunFolder, n: int, names: str) -> None:
    """Predictions of the run for n images of noise, as held-out samples."""
    predictor = package.load(folder.path)
    images, f = pictures(n), torch.full((n,), 250.0)
    batch = Batch(images, torch.tensor([[0.0, 0.0, 3.0]]).expand(n, 3), f, float(SIDE), torch.arange(n))
    table = columns(predictor.predict(predictor.raw(images.numpy(), f), f), batch)
    known = {"f": f.tolist(), "S": [float(SIDE)] * n, "file_name": [f"{names}{row}" for row in range(n)]}
    write_parquet(folder.held_out, table, known)


def pictures(n: int) -> torch.Tensor:
    return torch.randint(0, 256, (n, SIDE, SIDE, 3), generator=torch.Generator().manual_seed(3), dtype=torch.uint8)


def same(p: ProjectedHuber, q: ProjectedHuber, tolerance: float = 1e-4) -> None:
    torch.testing.assert_close(p.mode.double(), q.mode.double(), rtol=tolerance, atol=tolerance)
    torch.testing.assert_close(p.covariance_matrix.double(), q.covariance_matrix.double(), rtol=tolerance, atol=1e-6)


def test_equal_runs_are_one_run_and_different_ones_their_mixture(make: Callable) -> None:
    one, equal, other = make("a"), make("b", seed=1), make("c", seed=2, factor=1.5)
    images = pictures(4)
    single, second = (package.load(run.path) for run in (one, other))
    same(package.load([one.path, equal.path])(images, f=250.0), single(images, f=250.0))
    together = package.load([one.path, other.path])
    f = torch.full((4,), 250.0)
    mixture = together.members(together.raw(images.numpy(), f), f)
    alone = [predictor(images, f=250.0) for predictor in (single, second)]
    torch.testing.assert_close(mixture.mean, torch.stack([p.mean for p in alone]).mean(0), rtol=1e-4, atol=1e-5)
    same(together(images, f=250.0), mixture.closest)


def test_eight_views_are_predictions_of_turned_images_in_the_frame_of_the_image(make: Callable) -> None:
    """An ensemble of views turns with its image."""
    run = make("a")
    predictor, images, f = package.load(run.path, views=8), pictures(2), torch.full((2,), 250.0)
    assert predictor.familiarity is None, "held-out samples were not predicted from eight views"
    raw = predictor.raw(images.numpy(), f)
    assert raw.shape == (2, 8, 7)
    torch.testing.assert_close(raw[:, 0], package.load(run.path).raw(images.numpy(), f))
    mean = predictor.members(raw, f).mean
    for signs in EIGHT:
        mirror = torch.diag(torch.tensor([*signs[:2], 1.0], dtype=torch.float64))
        R = mirror @ (torch.eye(3).double()[[1, 0, 2]] if signs[2] < 0 else torch.eye(3).double())
        other = predictor.members(predictor.raw(turned(images, signs).numpy(), f), f)
        torch.testing.assert_close(other.mean, mean @ R.T, rtol=1e-5, atol=1e-6)


def test_familiar_is_uniform_over_held_out_samples(make: Callable, phd_exp: Callable) -> None:
    runs = [make("a"), make("b", seed=1, factor=1.5)]
    words = ("predict", f"run={runs[0].path},{runs[1].path}", "folder=photos")
    outcome = phd_exp(*words)
    assert outcome.status == 0, outcome.err
    lines = read_lines(outcome.out)
    f = torch.full((N,), 250.0)
    for predictor in (package.load([run.path for run in runs]), package.load(runs[0].path)):
        own = predictor.familiar(predictor.raw(pictures(N).numpy(), f), f)[1::2]
        # each sample and itself, up to the rounding of records, which may exchange neighbours
        np.testing.assert_allclose(np.sort(own), (1 + np.arange(1, N // 2 + 1)) / (N // 2 + 1), atol=1.1 / (N // 2))
    assert all(1 / (N // 2 + 1) <= line["familiar"] <= 1 for line in lines)
    recalibrated = read_lines(phd_exp(*words, "recalibrate=true").out)
    assert recalibrated[0]["familiar"] == lines[0]["familiar"]
    assert recalibrated[0]["mode"] == lines[0]["mode"]
    assert recalibrated[0]["covariance"] != lines[0]["covariance"]


def test_a_folder_of_seeds_is_one_ensemble_of_its_finished_runs(make: Callable) -> None:
    for seed in (0, 1, 2):
        make(f"seed{seed}", seed=seed)
    status_of(RunFolder(Path("runs/seed2")), state="failed")
    assert len(package.load("runs").network.networks) == 2


def test_familiar_needs_the_same_held_out_samples(make: Callable, phd_exp: Callable) -> None:
    make("a"), record(make("b", seed=1), N, "other")
    outcome = phd_exp("predict", "run=runs/a,runs/b", "folder=photos")
    assert outcome.status == 0, outcome.err
    assert "familiar" not in json.loads(outcome.out.splitlines()[0])


def test_fused_positions_are_those_of_the_closest_distributions(make: Callable) -> None:
    """The raw numbers of an ensemble predict in any batch."""
    predictor = package.load([make("a").path, make("b", seed=1, factor=1.5).path], views=8)
    images, f = pictures(4), torch.full((4,), 250.0)
    raw = predictor.raw(images.numpy(), f)
    assert raw.shape == (4, 16, 7)
    scenes = predictor.predict(raw[torch.tensor([[0, 1], [2, 3]])], f.reshape(2, 2))
    torch.testing.assert_close(scenes.mode.flatten(0, 1), predictor.predict(raw, f).mode)


@pytest.mark.parametrize(
    ("values", "command", "said"),
    [
        ({"data__image_size": 64}, "run=runs/a,runs/b", "data.image_size=48, but data.image_size=64 in runs/b"),
        ({"camera__focal_length": "constant"}, "run=runs/a,runs/b", "but camera.focal_length=constant in runs/b"),
        ({}, "run=runs/a,runs/c", "runs/c: no run"),
        ({}, "run=runs/a,runs/b views=8 recalibrate=true", "recorded for single runs alone"),
        ({}, "run=runs/a views=8 recalibrate=true", "cannot be recorded without the data set: photos/train"),
        ({}, "run=runs/a views=8 curve=true out=out", "curve: is recorded for single runs"),
        ({"backbone__depth": 11}, "run=runs/a,runs/b", "backbone"),
        ({"backbone___target_": "elsewhere.Net"}, "run=runs/a,runs/b", "add trust=elsewhere"),
    ],
)
def test_runs_that_do_not_fit_together_are_one_line(
    make: Callable, phd_exp: Callable, values: dict[str, Any], command: str, said: str
) -> None:
    make("a"), make("b", **values)
    assert said in phd_exp("predict", *command.split(), "folder=photos").error


def test_points_make_no_ensemble(make: Callable, composed: Callable, phd_exp: Callable) -> None:
    make("a")
    untrained(Path("runs/b"), composed(*SMALL, *OWN, "model=mae_vz"))
    assert "but model.head._target_=" in phd_exp("predict", "run=runs/a,runs/b", "folder=photos").error
    assert "predicts no uncertainty" in phd_exp("predict", "run=runs/b", "views=8", "folder=photos").error


def test_seeds_of_two_configurations_are_no_ensemble(make: Callable, phd_exp: Callable) -> None:
    make("seed0"), make("seed1-00000000", seed=1, optimizer__lr=0.5)
    refused = phd_exp("predict", "run=runs", "folder=photos").error
    assert "optimizer.lr=0.001, but optimizer.lr=0.5 in runs/seed1-00000000" in refused

"""One run: its record, and the same numbers whatever interrupts it."""

import json
import math
import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch

from phd_exp.config import check
from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.errors import RunError
from phd_exp.records.runs import RunFolder
from phd_exp.training.checkpoints import AtomicCheckpoints
from phd_exp.training.module import PositionModule
from phd_exp.training.train import require_same_config, train
from tests.support.recorded import once, status_of, weights

MODELS = ("probabilistic", "mae_vz", "mae_logz", "mae_xyz", "mae_constf")
ERRORS = {"loss", "projected_error_mm", "depth_error_mm"}
OF_A_DISTRIBUTION = {"nll", "depth_precision", "projected_precision"}
CALIBRATION = {"depth_ence", "projected_ence", "miscalibration_area", "depth_crps_mm", "left_out"}
LONG = ("model=mae_vz", "trainer.max_epochs=2", "data.batch_size=4", "recipe.warmup_steps=2")


def power_cut(*arguments: Any) -> None:
    raise RuntimeError("power cut")


def require_same(one: RunFolder, other: RunFolder) -> None:
    assert one.metrics() == other.metrics()
    assert one.results_file.read_bytes() == other.results_file.read_bytes()
    assert all(torch.equal(weight, weights(other)[name]) for name, weight in weights(one).items())


@pytest.fixture(params=MODELS, scope="module")
def model(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def uninterrupted(factory: pytest.TempPathFactory, run_in: Callable, model: str) -> RunFolder:
    """One run of a model for both test processes; curves are "drawn" as JSON."""
    words = (f"model={model}", "evaluation.calibration_every_n_epochs=1", "trainer.max_epochs=1")
    return RunFolder(
        once(
            factory, f"run of {model}", lambda path: run_in(path, *(LONG if model == "mae_vz" else words), draw=draw)
        )
    )


def draw(curves: dict[str, Any], file: Path) -> None:
    file.write_text(json.dumps(curves))


@pytest.fixture(scope="module")
def run(model: str, run_in: Callable, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return uninterrupted(tmp_path_factory, run_in, model)


@pytest.fixture(scope="module")
def whole(run_in: Callable, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A run of two epochs that nothing interrupts."""
    return uninterrupted(tmp_path_factory, run_in, "mae_vz")


def test_every_model_leaves_a_whole_record(run: RunFolder, model: str) -> None:
    assert run.is_finished()
    assert (run.results()["model"], run.results()["recipe"]) == (model, "strong")
    assert "regressor.backbone.map.weight" in weights(run)
    assert [row["epoch"] for row in run.metrics()] == ([-1, 0, 1] if model == "mae_vz" else [-1, 0])
    quantities = ERRORS | (OF_A_DISTRIBUTION if model == "probabilistic" else set())
    for row in run.metrics()[1:]:
        assert {f"{split}/{name}" for split in ("train", "test") for name in quantities} <= row.keys()
        assert all(math.isfinite(value) for value in row.values())
    scores = {f"test/calibration/{name}" for name in CALIBRATION}
    assert scores & row.keys() == (scores if model == "probabilistic" else set())


def test_results_are_those_of_the_last_epoch_and_of_the_predictions(run: RunFolder, model: str) -> None:
    results, table = run.results(), pd.read_parquet(run.predictions)
    untrained, *_, last = run.metrics()
    of_test = {key: value for key, value in last.items() if key.startswith("test/")}
    assert of_test == pytest.approx({key: results[key] for key in of_test}, rel=1e-6)  # logged in float32
    for name in ("projected_error_mm", "depth_error_mm"):
        assert results[f"test/{name}"] == pytest.approx(table[name].mean())
        assert results[f"untrained/test/{name}"] == untrained[f"test/{name}"]
    scored = {"depth_pit", "depth_crps", "energy_score"}
    assert scored & set(table.columns) == (scored if model == "probabilistic" else set())
    held_out = pd.read_parquet(run.held_out)
    assert list(held_out.columns) == list(table.columns)
    assert held_out["file_name"].tolist() == [f"{index:06d}.png" for index in range(16, 20)]
    assert (results["n_train"], results["n_held_out"], results["n_test"], len(table)) == (16, 4, 6, 6)


def test_the_untrained_network_predicts_the_centre_of_the_data_set(run: RunFolder, model: str) -> None:
    table = pd.read_parquet(run.predictions)
    xyz = torch.tensor(table[["x", "y", "z"]].to_numpy())
    mu_z0 = math.sqrt((3 / 600) * (5 / 400))
    z = {"mae_xyz": 4.0, "mae_constf": mu_z0 * math.sqrt(400 * 600)}.get(model, mu_z0 * table["f"].to_numpy())
    error = (torch.as_tensor(z) * xyz[:, 2] / xyz.norm(dim=1) - xyz.norm(dim=1)).abs()
    expected = pytest.approx(1000 * error.mean().item(), rel=1e-4)
    assert run.results()["untrained/test/depth_error_mm"] == expected


def test_a_run_comes_to_the_same_numbers_whatever_interrupts_it(
    run_in: Callable, whole: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    """A power cut at the first checkpoint, signals in the second epoch, a fault in its validation, a late signal."""
    run, steps, signals = RunFolder(tmp_path), list[tuple[int, int]](), dict[tuple[int, int], int]()
    training_step, validation_step = PositionModule.training_step, PositionModule.validation_step
    save_checkpoint = AtomicCheckpoints.save_checkpoint

    def save_and_fail(self: AtomicCheckpoints, *arguments: Any, **options: Any) -> None:
        save_checkpoint(self, *arguments, **options)
        power_cut()

    def fail_in_the_second_epoch(self: PositionModule, *arguments: Any) -> Any:
        return power_cut() if self.current_epoch == 1 else validation_step(self, *arguments)

    def signalled(self: PositionModule, data: Any, batch_idx: int) -> Any:
        steps.append((self.current_epoch, batch_idx))
        if steps[-1] in signals:
            os.kill(os.getpid(), signals[steps[-1]])
        return training_step(self, data, batch_idx)

    def require_interrupted() -> None:
        with pytest.raises(RuntimeError, match="power cut"):
            run_in(tmp_path, *LONG)

    def require_stopped(signum: signal.Signals, batch: int) -> None:
        before = signal.signal(signum, power_cut)
        signals.update({(1, batch): signum})
        try:
            require_interrupted()
            assert signal.getsignal(signum) is power_cut
        finally:
            signals.clear()
            signal.signal(signum, before)

    monkeypatch.setattr(PositionModule, "training_step", signalled)
    with monkeypatch.context() as patch:
        patch.setattr(AtomicCheckpoints, "save_checkpoint", save_and_fail)
        require_interrupted()
    assert [row["epoch"] for row in run.metrics()] == [-1, 0], "an epoch is recorded before its checkpoint"
    require_stopped(signal.SIGINT, batch=0)
    require_stopped(signal.SIGTERM, batch=1)
    with monkeypatch.context() as patch:
        patch.setattr(PositionModule, "validation_step", fail_in_the_second_epoch)
        require_interrupted()
    assert (status_of(run).state, status_of(run).error) == ("failed", "RuntimeError: power cut")
    assert steps == [(epoch, step) for epoch in range(2) for step in range(4)], "each once"
    require_stopped(signal.SIGTERM, batch=3)
    assert steps[8:] == [(1, 2), (1, 3)], "those after the last checkpoint"
    assert "resuming at epoch 2 of 2" in capsys.readouterr().out
    require_same(run_in(tmp_path, *LONG), whole)


def test_evaluating_less_often_changes_no_number(run_in: Callable, whole: RunFolder, tmp_path: Path) -> None:
    other = run_in(tmp_path, *LONG, "evaluation.every_n_epochs=2", "evaluation.calibration_every_n_epochs=2")
    assert all(torch.equal(weight, weights(whole)[name]) for name, weight in weights(other).items())
    tested = [any(key.startswith("test/") for key in row) for row in other.metrics()]
    assert tested == [True, False, True]
    for row, same in zip(whole.metrics(), other.metrics(), strict=True):
        assert same.items() <= row.items()
    assert other.results() == whole.results()


@pytest.mark.parametrize("model", ["probabilistic"], scope="module")
def test_curves_are_recorded_and_drawn(run: RunFolder) -> None:
    drawn = {file.stem: json.loads(file.read_text()) for file in run.calibration.glob("*.png")}
    assert drawn.keys() == {"epoch-0000", "final"}
    for name, curves in drawn.items():
        assert curves == json.loads(run.curves(name).read_text())
        assert curves.keys() == {"depth", "projected"}
        for curve in curves.values():
            assert len(curve["predicted"]) == len(curve["empirical"]) == 6 - curve["window"] + 1


def test_a_finished_run_is_not_run_again_and_never_taken_for_another(
    run_in: Callable, whole: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("phd_exp.training.train.run", lambda *_: pytest.fail("run again"))
    run_in(whole.path, *LONG)
    with pytest.raises(RunError, match=r"holds a run with optimizer.lr=0.002, but optimizer.lr=0.5 is asked"):
        run_in(whole.path, *LONG, "optimizer.lr=0.5")


def test_a_record_without_an_argument_that_is_younger_is_of_the_same_run(
    run_in: Callable, whole: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("phd_exp.training.train.run", lambda *_: pytest.fail("run again"))
    old = RunFolder(shutil.copytree(whole.path, tmp_path / "old"))
    record = old.config()
    assert record["backbone"].pop("points") == 0
    old.write_config(record)
    run_in(old.path, *LONG)
    with pytest.raises(RunError, match=r"backbone.points=nothing, but backbone.points=2 is asked"):
        run_in(old.path, *LONG, "backbone.points=2")


def test_a_loss_that_is_not_finite_names_its_samples(
    run_in: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    training_step = PositionModule.training_step

    def blind_to_one(self: PositionModule, batch: Any, batch_idx: int) -> Any:
        if self.current_epoch == 1:
            batch.xyz[batch.row == 3] = torch.nan  # a copy of the data set's
        return training_step(self, batch, batch_idx)

    monkeypatch.setattr(PositionModule, "training_step", blind_to_one)
    with pytest.raises(RunError, match=r"loss is nan in epoch 2/2, at train samples 000003\.png; the last") as caught:
        run_in(tmp_path, *LONG)
    assert "lower optimizer.lr" in str(caught.value)
    assert all(weight.isfinite().all() for weight in weights(RunFolder(tmp_path)).values())


@pytest.mark.parametrize(
    ("asked", "words", "expected"),
    [("", (), 8), ("3", (), 3), ("3,2", (), 3), ("16", (), 8), ("x", (), 8), ("3", ("trainer.threads=2",), 2)],
)
def test_threads_are_those_of_the_configuration_or_of_omp_num_threads_or_the_cores(
    composed: Callable,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    asked: str,
    words: tuple[str, ...],
    expected: int,
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", asked)
    monkeypatch.setattr("phd_exp.training.train.run", lambda config, folder, draw, threads, **_: {"threads": threads})
    config = check(composed("preset=smoke", f"data.root={tmp_path}", *words))
    assert train(config, RunFolder(tmp_path / "run"), None, cores=8) == {"threads": expected}


def test_a_run_on_renders_and_photographs_is_tested_on_renders_and_notices_other_labels(
    run_in: Callable, composed: Callable, handmade: DatasetFolder, tmp_path: Path
) -> None:
    photos = shutil.copytree(handmade.root / "test", tmp_path / "photos")
    words = ("trainer.max_epochs=1", f"data.photographs.folder={photos}", "data.photographs.share=0.5")
    mixed, plain = run_in(tmp_path / "mixed", *words), run_in(tmp_path / "plain", *words[:1])
    one, other = (pd.read_parquet(run.predictions) for run in (mixed, plain))
    assert one["file_name"].tolist() == other["file_name"].tolist()
    assert (one["mode_z"] != other["mode_z"]).all()
    config = check(mixed.config())
    require_same_config(mixed, config)
    metadata = photos / "metadata.jsonl"
    metadata.write_text(metadata.read_text() + "\n")
    with pytest.raises(RunError, match=f"a run on {photos} as it was before its annotations changed"):
        require_same_config(mixed, config)

"""The user's own parts from the command line and from Python; what is stored is built only on request."""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import timm
import torch
import yaml
from PIL import Image

import phd_exp as package
from phd_exp.evaluation.parquet import read_table
from phd_exp.records.runs import RunFolder
from phd_exp.training.predictions import TRAINING
from tests.support.own_parts import QUICK
from tests.support.recorded import only_run, status_of

RUNS = Path("runs")


@pytest.mark.parametrize(
    "words",
    [
        ["loss=l1", "backbone=pooled"],
        ["recipe=strong", "backbone=located", "recipe.localisation=1"],
        ["model=own", "camera=shown", "optimizer._target_=torch.optim.RMSprop", "~optimizer.fused"],
        ["model=student_t", "backbone._target_=torchvision.models.shufflenet_v2_x0_5"],
        ["camera=constant", "model=mae_vz"],
        ["model=decomposed", "recipe=strong", "optimizer=adam"],
    ],
    ids=" ".join,
)
def test_own_parts_train_and_are_recorded(own: Callable, words: list[str]) -> None:
    outcome = own(*words, "trainer.max_epochs=1")
    assert outcome.status == 0, outcome.err
    run = only_run(RUNS)
    status = status_of(run)
    assert status.state == "finished"
    assert Path(status.custom["ownparts.Squares"]).name == "ownparts.py"
    assert len(read_table(run.predictions)["z"]) == 16


def test_pretrained_weights_are_loaded_once(own: Callable, tmp_path: Path) -> None:
    weights = {"layer.weight": torch.full((8, 3, 3, 3), 0.5), "layer.bias": torch.zeros(8)}
    torch.save(weights, tmp_path / "weights.pth")
    assert own("backbone=pooled", "+backbone.pretrained=weights.pth", "optimizer.lr=1e-12").status == 0
    (tmp_path / "weights.pth").unlink()  # of the checkpoint from here on
    predictor = package.load(only_run(RUNS).path, trust=("ownnet",))
    layer = dict(predictor.network.named_parameters())["networks.0.backbone.network.layer.weight"]
    torch.testing.assert_close(layer, torch.full_like(layer, 0.5), rtol=0, atol=1e-6)


def test_a_network_of_timm_trains_and_needs_its_file_once(own: Callable, tmp_path: Path) -> None:
    torch.manual_seed(0)
    theirs = timm.create_model("test_resnet").state_dict()
    torch.save(theirs, tmp_path / "tiny.pth")
    parts = ("name=test_resnet", "pretrained=tiny.pth", "frozen=[bn1]")
    words = ("backbone=imagenet", "recipe=strong", *(f"backbone.network.{part}" for part in parts))
    outcome = own(*words)
    assert outcome.status == 0, outcome.err
    (tmp_path / "tiny.pth").unlink()
    run = only_run(RUNS)
    network = package.load(run.path).network.networks[0].backbone.network.network
    torch.testing.assert_close(network.bn1.weight.cpu(), theirs["bn1.weight"])
    assert not torch.equal(network.layer2[0].conv1.weight.cpu(), theirs["layer2.0.conv1.weight"])
    assert own(*words, f"init={run.path}", "runs=further").status == 0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["backbone._target_=ownnet.Raises"], "backbone: KeyError: 'boom' ("),
        (["backbone._target_=ownnet.Scalar"], "backbone: returned () for 2 images of 32 px; expected (2, n)"),
        (["backbone._target_=ownnet.NaN"], "backbone: returned features that are not finite for a black image ("),
        (["backbone._target_=ownnet.NoModule"], "backbone: ownnet.NoModule makes a NoModule; expected a"),
        (["backbone._target_=broken.X"], "cannot be imported (ModuleNotFoundError: No module named 'nothing_here' ("),
        (["+backbone.depth=3"], "backbone.depth: unknown key, did you mean 'width'?; ownnet.Mine takes width"),
        (["loss._target_=ownloss.wrong_shape"], "loss: returned (2, 3) for 2 images; expected (2,) or () ("),
        (["model.head._target_=ownnet.Mine"], "model.head._target_: 'ownnet.Mine' is no head; see conf/model"),
        (["+callbacks.mine._target_=ownnet.Mine"], "callbacks.mine: makes a Mine; expected a lightning.Callback ("),
        (["+logger.mine._target_=ownnet.Mine"], "logger.mine: makes a Mine; expected a Logger of Lightning ("),
        (["callbacks=early_stopping", "callbacks.early_stopping.monitor=test/loss"], "test samples choose nothing"),
        (["callbacks=best_checkpoint", "+callbacks.best_checkpoint.dirpath=."], "got '.'; expected null"),
        (["callbacks=early_stopping", "callbacks.early_stopping.monitor=held_out/los"], "mean 'held_out/loss'?"),
        (["+trainer.fast_dev_run=true"], "trainer.fast_dev_run: the run record depends on it; instead set trainer"),
        (["+trainer.limit_train_batches=0"], "trained no whole epoch, so there is no run"),
        (["backbone=pooled", "+backbone.pretrained=no.pth"], "backbone: pretrained: got 'no.pth'; expected a file"),
        (["backbone=located", "backbone.network._target_=ownnet.Mine"], "expected feature maps (2, n, rows,"),
        (["+trainer.gradient_clip=1"], "trainer.gradient_clip: unknown key, did you mean 'gradient_clip_val'?"),
    ],
    ids=str,
)
def test_bad_parts_are_one_line(own: Callable, words: list[str], message: str) -> None:
    line = own(*words).error
    assert message in line
    if message.endswith("("):
        assert any(file in line for file in ("ownnet.py", "ownloss.py", "broken.py"))


def test_an_error_in_the_middle_is_recorded_and_the_run_resumes(own: Callable) -> None:
    words = ("+callbacks.mine._target_=ownparts.Raising", "trainer.max_epochs=3")
    line = own(*words).error
    assert "ZeroDivisionError: my callback (" in line
    assert "ownparts.py, line" in line
    run = only_run(RUNS)
    assert (status_of(run).state, status_of(run).error) == ("failed", "ZeroDivisionError: my callback")
    assert run.last_checkpoint.exists()
    del import_module("ownparts").Raising.on_train_epoch_end  # mended
    outcome = own(*words)
    assert outcome.status == 0, outcome.err
    assert "resuming at epoch 2 of 3" in outcome.out


def test_a_stored_run_builds_foreign_parts_only_on_request(own: Callable, phd_exp: Callable, tmp_path: Path) -> None:
    assert own().status == 0
    run = only_run(RUNS)
    words = ("predict", f"run={run.path}", "image=x.png", "f=60")
    Image.new("RGB", (32, 32)).save(tmp_path / "x.png")
    assert re.search("'ownnet.Mine' is not built from .*; .* add trust=ownnet", phd_exp(*words).error)
    trusted = phd_exp(*words, "trust=ownnet")
    assert trusted.status == 0, trusted.err
    assert "mode" in json.loads(trusted.out)


@pytest.mark.parametrize("key", ["loss", "optimizer", "callbacks", "logger"])
def test_what_only_training_builds_is_not_looked_at(run: RunFolder, tmp_path: Path, key: str) -> None:
    """`run` has the project's own parts, and what a stranger adds to them is not executed."""
    stolen = RunFolder(tmp_path / "stolen")
    shutil.copytree(run.path, stolen.path)
    config = yaml.safe_load(stolen.config_file.read_text())
    evil = {"_target_": "os.mkdir", "path": str(tmp_path / "executed")}
    config[key] = {"evil": evil, "odd": 3} if key in ("callbacks", "logger") else evil
    stolen.config_file.write_text(yaml.safe_dump(config))
    package.load(stolen.path)
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize(
    "words",
    [
        "max_steps=3 gradient_clip_val=0.1 detect_anomaly=true profiler=simple enable_model_summary=true",
        "accumulate_grad_batches=2 limit_val_batches=1",
        "overfit_batches=1",
    ],
)
def test_arguments_of_lightnings_trainer(own: Callable, words: str) -> None:
    outcome = own(*(f"+trainer.{word}" for word in words.split()))
    assert outcome.status == 0, outcome.err
    run = only_run(RUNS)
    arguments = {name: yaml.safe_load(value) for name, value in (word.split("=") for word in words.split())}
    assert run.config()["trainer"].items() >= arguments.items()
    assert run.path.name.startswith("seed0-")


def test_a_limited_epoch_is_a_whole_one(own: Callable) -> None:
    """Each epoch has its own order of the batches, however many of them are used."""
    words = ("+trainer.limit_train_batches=1", "trainer.max_epochs=4", "model=mae_vz")
    assert own(*words).status == 0
    whole = only_run(RUNS).metrics()
    assert own(*words[:1], "trainer.max_epochs=2", words[2], "runs=resumed", "seed=0").status == 0
    assert [row["epoch"] for row in whole] == [-1, 0, 1, 2, 3]
    assert only_run(Path("resumed")).metrics() == whole[:3]


def test_callbacks_choose_by_held_out_samples(own: Callable) -> None:
    words = ("callbacks=[early_stopping,best_checkpoint]", "callbacks.early_stopping.patience=1")
    assert own(*words, "trainer.max_epochs=40", "optimizer.lr=0.1").status == 0
    run = only_run(RUNS)
    losses = [row["held_out/loss"] for row in run.metrics() if "held_out/loss" in row]
    assert len(losses) < 40
    assert {key for key in run.metrics()[-1] if key.startswith("train/")} == {f"train/{name}" for name in TRAINING}
    assert losses[-1] >= min(losses)
    assert run.best_checkpoint.name == "best.ckpt"
    table = read_table(run.held_out)
    assert table["nll"][::2].mean() == pytest.approx(min(losses), rel=1e-5)


def test_a_run_without_its_best_checkpoint_uses_the_last(own: Callable) -> None:
    assert own("callbacks=ema", "+trainer.gradient_clip_val=1").status == 0
    run = only_run(RUNS)
    assert run.best_checkpoint == run.last_checkpoint
    source = import_module("ownparts").Squares({"test": 16}, 32).samples("test")
    found = package.load(run.path, trust=("ownnet",))(source.image.numpy(), f=source.f)
    np.testing.assert_allclose(found.mode[:, 2], read_table(run.predictions)["mode_z"], rtol=1e-5)


@pytest.mark.slow
def test_every_logger_receives_the_record(own: Callable, tmp_path: Path) -> None:
    pytest.importorskip("tensorboard", reason="needs `pip install 'phd_exp[loggers]'`")
    pytest.importorskip("mlflow", reason="needs `pip install 'phd_exp[loggers]'`")
    words = ("logger=[csv,wandb,tensorboard,mlflow]", "+logger.own._target_=ownparts.Keeping")
    outcome = own(*words)
    assert outcome.status == 0, outcome.err
    run = only_run(RUNS)
    epochs = [row["test/nll"] for row in run.metrics()]
    kept = [row["test/nll"] for _, row in import_module("ownparts").Keeping.rows if "test/nll" in row]
    np.testing.assert_allclose(kept, epochs, rtol=1e-6)
    logged = pd.read_csv(run.path / "csv" / "metrics.csv")["test/nll"].dropna()
    np.testing.assert_allclose(logged, epochs, rtol=1e-5)
    (file,) = run.path.glob("mlflow/*/*/metrics/test/nll")
    np.testing.assert_allclose([float(line.split()[1]) for line in file.read_text().splitlines()], epochs, rtol=1e-5)
    assert list(run.path.glob("wandb/offline-run-*/run-*.wandb"))
    assert list(run.path.glob("tensorboard/events*"))
    assert not (tmp_path / "mlruns").exists()


def test_training_from_python(own: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    words = [word for word in QUICK if not word.startswith("--")]
    run = package.train(words, config_dir="my_conf")
    assert run.results["test/nll"] == pytest.approx(run.predictions["nll"].mean(), rel=1e-6)
    mode = run.predictor()(np.zeros((2, 32, 32, 3), np.uint8), f=64.0).mode
    assert mode.shape == (2, 3)
    assert package.train(words, config_dir="my_conf") == run
    assert own().out.startswith(f"{run.path}: finished already"), "the command line finds it too"
    table = package.runs()
    assert table[["data", "model", "state"]].values.tolist() == [["squares", "probabilistic", "finished"]]
    assert table["test/nll"][0] == run.results["test/nll"]


@pytest.mark.slow
def test_only_what_is_chosen_is_imported() -> None:
    names = ("wandb", "mlflow", "tensorboard", "optuna", "timm")
    code = f"import sys, phd_exp.training.run; print([name for name in {names} if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"

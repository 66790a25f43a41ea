"""recipe=strong from the command line: every kind of model trains by it, is found again, and can be exported."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from phd_exp.records.runs import find_runs

STRONG = ("recipe=strong", "data.image_size=64", "logger=none", "trainer.max_epochs=1")


@pytest.mark.parametrize("model", ["probabilistic", "mae_xyz", "mae_constf"])
def test_models_train_by_it(train: Callable, tmp_path: Path, model: str) -> None:
    outcome = train(f"model={model}", *STRONG)
    assert outcome.status == 0, outcome.err
    (run,) = find_runs(tmp_path / "runs")
    assert (
        run.path.relative_to(tmp_path / "runs").as_posix().startswith(f"smoke+strong/default/{model}/seed0-")
    )
    assert run.results()["recipe"] == "strong"
    weights = torch.load(run.last_checkpoint, weights_only=True)
    names = weights["state_dict"].keys()
    assert "regressor.backbone.map.weight" in names
    assert weights["lr_schedulers"][0]["last_epoch"] == weights["global_step"] > 0
    again = train(f"model={model}", *STRONG)
    assert "finished already" in again.out


@pytest.mark.slow
def test_it_is_exported(train: Callable, phd_exp: Callable, tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime", reason="export needs `pip install 'phd_exp[export]'`")
    assert train(*STRONG).status == 0
    (run,) = find_runs(tmp_path / "runs")
    outcome = phd_exp("export", f"run={run.path}", "out=network.onnx")
    assert outcome.status == 0, outcome.err
    assert (tmp_path / "network.onnx").exists()


def test_a_map_is_asked_of_a_backbone_that_has_one(train: Callable) -> None:
    outcome = train("recipe.localisation=1")
    assert outcome.status == 2
    assert outcome.err.startswith("error: recipe.localisation: got 1.0, but this backbone does not say where")
    assert "\n" not in outcome.err.strip()

"""What choices resolve to, and the losses of the first 20 steps of trainings on fixed photographs."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from lightning import Callback

from phd_exp.cli import conf_folder
from phd_exp.config import check
from phd_exp.records.choices import flatten
from phd_exp.records.runs import RunFolder
from phd_exp.training.train import train
from tests.golden.conftest import photograph, placed

WORDS = (
    "preset=smoke", "data=folder", "data.n_held_out=4", "data.batch_size=8", "data.image_size=64", "logger=none",
    "trainer=cpu", "trainer.threads=1", "trainer.max_epochs=4", "trainer.progress_bar=false",
    "trainer.precision=float32", "evaluation.every_n_epochs=4",
)  # fmt: skip
TRAININGS = {
    name: (f"model={name}",) for name in ("probabilistic", "mae_vz", "mae_logz", "mae_xyz", "gaussian", "rounded_t")
}
TRAININGS["strong"] = ("model=probabilistic", "recipe=strong")
UNCHECKED = ("hydra", "experiment")  # of several runs


class Losses(Callback):
    """The loss of each step."""

    def __init__(self) -> None:
        self.found: list[float] = []

    def on_train_batch_end(self, trainer: Any, module: Any, outputs: Any, *batch: Any) -> None:
        self.found.append(float(outputs["loss"]))


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "photographs"
    for split, some in (("train", range(44)), ("test", range(50, 58))):
        photograph(folder / split, [placed(k, f=150.0 + k % 7, across=0.6) for k in some], (64, 64))
    return folder


@pytest.mark.parametrize("name", TRAININGS)
def test_losses_of_a_training(
    golden: Callable, composed: Callable[..., Any], photographs: Path, tmp_path: Path, name: str
) -> None:
    config = check(composed(*WORDS, *TRAININGS[name], f"data.folder={photographs}"))
    results = train(config, RunFolder(tmp_path / "run"), None, cores=1, callbacks=[losses := Losses()])
    golden(f"losses/{name}", {"losses.json": losses.found, "results.json": results})


@pytest.mark.slow
def test_each_choice_changes_the_same_values(golden: Callable, composed: Callable[..., dict[str, Any]]) -> None:
    """The whole configuration of the paper's protocol, and what each single choice of a group changes in it."""
    base = flatten(composed())
    made = {"": base}
    for file in sorted(conf_folder().glob("*/*.yaml")):
        if (group := file.parent.name) not in UNCHECKED:
            choice = f"{group}=[{file.stem}]" if group in ("callbacks", "shift") else f"{group}={file.stem}"
            found = flatten(composed(choice))
            gone = dict.fromkeys(base.keys() - found.keys(), "gone")
            made[choice] = {k: v for k, v in found.items() if base.get(k, ...) != v} | dict(sorted(gone.items()))
    golden("configurations", {"configurations.json": made})

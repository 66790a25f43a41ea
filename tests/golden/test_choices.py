"""What choices resolve to, what is rendered for them, and the losses of 20 steps on fixed photographs."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from lightning.pytorch.callbacks import LambdaCallback

from phd_exp.cli import choices_of
from phd_exp.cli.help import OF_VERB
from phd_exp.config import check
from phd_exp.records.choices import flatten
from phd_exp.records.runs import RunFolder
from phd_exp.training.train import train
from tests.golden.compare import read
from tests.golden.conftest import photograph, placed
from tests.support.meshes import solid, write_mesh
from tests.support.untrained import read_metadata

SMALL = (
    "data.sensor_size=56", "data.f_range=[300,500]", "data.samples_per_pixel=4", "data.n_held_out=0", "data.n_test=1",
    "data.workers=1",
)  # fmt: skip
RENDERS = {name: ("data.n_train=2",) for name in ("default", "occl", "scale", "occl_scale")}
RENDERS["object"] = ("data.n_train=1", "data.xy_range=0.2", "data.distractors=1", "data.mesh=part.stl")
STEPS = (
    "preset=smoke", "data=folder", "data.n_held_out=4", "data.batch_size=8", "data.image_size=64", "logger=none",
    "trainer=cpu", "trainer.threads=1", "trainer.max_epochs=4", "trainer.progress_bar=false",
    "trainer.precision=float32", "evaluation.every_n_epochs=4", "optimizer.lr=1e-4",
)  # fmt: skip
"""With steps of 1e-3, Adam would amplify the last bits of two processors to 10 % of a loss."""
SLOW = ("scale", "mae_vz", "mae_xyz")  # the others cover most of their code
TRAININGS = ("probabilistic", "mae_logz", "gaussian", "rounded_t", "probabilistic recipe=strong", "mae_vz", "mae_xyz")


def each(*names: str) -> list[Any]:
    return [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in names]


@pytest.mark.parametrize("variant", each(*RENDERS))
def test_renders_and_their_metadata(golden: Callable, phd_exp: Callable, tmp_path: Path, variant: str) -> None:
    write_mesh(tmp_path / "part.stl", solid("cylinder"))
    outcome = phd_exp("render", f"data={variant}", *SMALL, *RENDERS[variant])
    assert outcome.status == 0, outcome.err
    made: dict[str, Any] = {}
    for split in ("train", "test"):
        folder = tmp_path / "renders" / variant / split
        made[f"{split}.jsonl"] = records = read_metadata(folder)
        for record in records:
            del record["sha256"]  # of pixels that differ by a level
            (folder / record["file_name"]).rename(picture := folder / f"{split}-{record['index']}.webp")
            made[picture.name] = read(picture)
    golden(f"pictures/{variant}", made)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "photographs"
    for split, some in (("train", range(44)), ("test", range(50, 58))):
        photograph(folder / split, [placed(k, f=150.0 + k % 7, across=0.6) for k in some], (64, 64))
    return folder


@pytest.mark.parametrize("model", each(*TRAININGS))
def test_losses_of_a_training(
    golden: Callable, composed: Callable[..., Any], photographs: Path, tmp_path: Path, model: str
) -> None:
    config = check(composed(*STEPS, *f"model={model}".split(), f"data.folder={photographs}"))
    losses: list[float] = []
    noting = LambdaCallback(
        on_train_batch_end=lambda trainer, module, outputs, *of: losses.append(outputs["loss"].item())
    )
    results = train(config, RunFolder(tmp_path / "run"), None, cores=1, callbacks=[noting])
    golden(f"losses/{model.rpartition('=')[2]}", {"losses.json": losses, "results.json": results})


@pytest.mark.slow
def test_each_choice_changes_the_same_values(golden: Callable, composed: Callable[..., dict[str, Any]]) -> None:
    """The whole configuration of the paper's protocol, and what each single choice of a group changes in it."""
    made = {"": (base := flatten(composed()))}
    for group in sorted({*OF_VERB["train"]} - {"experiment"}):  # which is of several runs
        for name in choices_of(group):
            choice = f"{group}=[{name}]" if group in ("callbacks", "shift") else f"{group}={name}"
            found = flatten(composed(choice))
            gone = {key: "gone" for key in base if key not in found}
            made[choice] = {key: value for key, value in found.items() if base.get(key, ...) != value} | gone
    golden("configurations", {"configurations.json": made})

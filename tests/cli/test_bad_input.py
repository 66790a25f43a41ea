"""Each wrong value is found before anything is written; `tests/bad_input` has the wrong commands."""

import re
from collections.abc import Callable
from copy import deepcopy
from functools import cache, reduce
from operator import getitem
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

from phd_exp.cli import jobs
from phd_exp.config import RenderConfig, RunConfig, check, check_render
from phd_exp.records.choices import flatten
from phd_exp.records.errors import ConfigError
from phd_exp.records.runs import RunFolder
from phd_exp.training.train import require_possible

OPEN = ("backbone", "loss", "optimizer", "logger", "callbacks", "model.head")
WRONG_VALUES = [
    # (words, parts of the line)
    ("+model.typo=1", "model.typo: unknown key; expected one of name, head"),
    ("+data.n_trian=1", "data.n_trian: unknown key, did you mean 'n_train'?"),
    ("data.n_train=true", "data.n_train: got True; expected a valid integer"),
    ("data.f_range=[2000,1200]", "data.f_range: "),
    ("data.image_size=448", "image_size=448 is larger than sensor_size=224"),
    ("data.batch_size=64", "batch_size=64"),
    ("data.variant=../elsewhere", "data.variant: "),
    ("evaluation.multiview.scenes=9 data=multiview", "data=multiview is not rendered with one view"),
    ("evaluation.multiview.scenes=9 data=scale model=mae_vz", "model=mae_vz has no density"),
    ("evaluation.sequences=[[4,20]] data=folder data.folder=photos", "is not rendered in single images"),
    ("evaluation.sequences=[[4,20],[2,20]]", "expected pairs [sequences, frames] of different frames"),
    ("data=sequence", "data.n_train: got 32; expected a multiple of data.frames x data.views = 20"),
    ("photometry=surfaces", "recipe.augmentation.prints: got 0.6, but "),
    ("recipe.augmentation.plain=0.5", "recipe.augmentation.plain: got 0.5"),
    ("evaluation.eight_views=true model=mae_vz", "evaluation.eight_views: model=mae_vz predicts points"),
    ("loss=mae", "loss: takes a PointEstimate, but model=probabilistic predicts a ProjectedHuber"),
    ("loss._target_=torch.optim.Nadam", "loss._target_: 'torch.optim.Nadam' cannot be imported"),
    ("optimizer.lr=-1", "optimizer: "),
    ("trainer=ddp trainer.accelerator=cpu trainer.devices=3", "trainer.devices: got 3, which does not divide batch"),
    ("data=folder", "data.folder: missing; expected data.folder=VALUE"),
    ("render data=folder", "data=folder: there is nothing to render, these are your own images"),
    ("render shard=4/4", "shard: got '4/4'; expected INDEX/COUNT with 0 <= INDEX < COUNT, such as 0/4"),
    ("render +shards=0/2", "shards: unknown key"),
]


@cache
def composed(verb: str, *typed: str) -> dict[str, Any]:
    return jobs.composed(["preset=smoke", *typed], config_name="render" if verb == "render" else "config")


def require_sound(verb: str, config: dict[str, Any], runs: Path) -> None:
    """What a verb checks before it does anything."""
    if verb == "render":
        check_render(config)
    else:
        require_possible(check(config), RunFolder(runs / "run"))


@pytest.mark.parametrize(("typed", "part"), WRONG_VALUES)
def test_a_wrong_value_is_one_line(tmp_path: Path, typed: str, part: str) -> None:
    verb, *words = typed.split() if typed.startswith("render ") else ["train", *typed.split()]
    with pytest.raises(ConfigError) as refused:
        require_sound(verb, composed(verb, *words), tmp_path)
    (line,) = str(refused.value).splitlines()
    assert part in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("verb", "model"), [("train", RunConfig), ("render", RenderConfig)])
@pytest.mark.parametrize("wrong", [[[1]], -(10**9)], ids=["another type", "below every range"])
def test_every_key_refuses_a_wrong_value(tmp_path: Path, verb: str, model: type[BaseModel], wrong: Any) -> None:
    """All at once: of every key that has no class of the user's choice a list, and of every number a negative one."""
    config = deepcopy(composed(verb))
    values = {key: value for key, value in flatten(config).items() if not key.startswith(OPEN)}
    known = [key for key in values if key.partition(".")[0] in model.model_fields]
    keys = [key for key in known if isinstance(wrong, list) or isinstance(values[key], int | float)]
    for key in keys:
        *sections, name = key.split(".")
        reduce(getitem, sections, config)[name] = wrong
    with pytest.raises(ConfigError) as refused:
        require_sound(verb, config, tmp_path)
    named = [re.split(r"(?:\.\d)*: ", line)[0] for line in str(refused.value).splitlines()]
    assert [key for key in keys if key not in named] == []


def test_wandb_without_a_key_is_one_line(phd_exp: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NETRC", str(tmp_path / "none"))
    monkeypatch.delenv("WANDB_API_KEY", raising=False)
    refused = phd_exp("preset=smoke", "logger.wandb.offline=false").error
    assert "logger.wandb.offline: got false, but wandb has no API key" in refused
    assert list(tmp_path.iterdir()) == []


def test_each_thing_wrong_gets_its_own_line(phd_exp: Callable) -> None:
    outcome = phd_exp("preset=smoke", "seed=-1", "data.n_test=0")
    assert outcome.err.splitlines() == [
        "error: seed: got -1; expected to be greater than or equal to 0",
        "error: data.n_test: got 0; expected to be greater than or equal to 1",
    ]

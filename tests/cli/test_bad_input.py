"""Each wrong value is found before anything is written; `tests/bad_input` has the wrong commands."""

import re
from collections.abc import Callable
from copy import deepcopy
from functools import cache
from itertools import compress
from pathlib import Path
from typing import Any

import hydra
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf
from pydantic import BaseModel

from phd_exp.cli import conf_folder
from phd_exp.cli.jobs import plain
from phd_exp.config import RenderConfig, RunConfig, check, check_render
from phd_exp.records.choices import flatten
from phd_exp.records.errors import ConfigError
from phd_exp.records.runs import RunFolder
from phd_exp.training.train import require_possible

NOTHING_TO_RENDER = "data=folder: there is nothing to render, these are your own images"
FOLDER = ["data=folder", "data.folder=photos"]
TOGETHER = ["trainer=ddp", "trainer.accelerator=cpu"]
MULTIVIEW = "evaluation.multiview.scenes"
SEQUENCES = "evaluation.sequences=[[4,20]]"
OPEN = ("backbone", "loss", "optimizer", "logger", "callbacks", "model.head")
WRONG_VALUES = [
    # (arguments, parts of the line): found once Hydra has composed the configuration
    (["+model.typo=1"], ["model.typo", "unknown key", "expected one of name, head"]),
    (["+data.n_trian=1"], ["data.n_trian", "did you mean 'n_train'"]),
    (["+typo=1"], ["typo", "unknown key"]),
    (["data.n_train=true"], ["data.n_train", "True", "integer"]),
    (["data.f_range=[2000,1200]"], ["data.f_range", "lower bound"]),
    (["data.image_size=448"], ["data", "image_size=448", "sensor_size=224"]),
    (["data.batch_size=64"], ["data", "batch_size=64", "32 training samples"]),
    (["data.variant=../elsewhere"], ["data.variant"]),
    (["evaluation.multiview.angle_range=[60,20]"], ["evaluation.multiview.angle_range", "lower bound"]),
    ([f"{MULTIVIEW}=9", "data=multiview"], ["data=multiview is not rendered with one view", "expected data=scale"]),
    ([f"{MULTIVIEW}=9", *FOLDER], ["is not rendered", "expected data=scale"]),
    ([f"{MULTIVIEW}=9", "data=scale", "model=mae_vz"], ["model=mae_vz has no density", "expected model=prob"]),
    (["data=sequence"], ["data.n_train: got 32", "multiple of data.frames x data.views = 20"]),
    (
        [SEQUENCES, "data=sequence", "data.n_train=40"],
        ["data=sequence is not rendered in single images", "expected data=scale"],
    ),
    ([SEQUENCES, *FOLDER], ["is not rendered in single images", "expected data=scale"]),
    ([SEQUENCES, "model=mae_vz"], ["model=mae_vz predicts no Projected Huber density", "expected model=prob"]),
    (["evaluation.sequences=[[4,20],[2,20]]"], ["expected pairs [sequences, frames] of different frames"]),
    (["evaluation.sequence_cameras=3"], ["evaluation.sequence_cameras", "got 3"]),
    (["photometry=surfaces"], ["recipe.augmentation.prints: got 0.6", "expected 0, or data=object"]),
    (["recipe.augmentation.plain=0.5"], ["recipe.augmentation.plain: got 0.5", "augmentation.backdrops above 0"]),
    (["evaluation.eight_views=true", "model=mae_vz"], ["evaluation.eight_views", "model=mae_vz predicts points"]),
    (["loss=mae"], ["loss", "PointEstimate", "model=probabilistic", "ProjectedHuber"]),
    (["model=mae_vz", "loss=nll"], ["loss", "Density", "model=mae_vz"]),
    (["loss._target_=torch.optim.Nadam"], ["loss._target_", "cannot be imported"]),
    (["optimizer.lr=-1"], ["optimizer: ", "learning rate", "-1"]),
    ([*TOGETHER, "trainer.devices=3"], ["trainer.devices: got 3, which does not divide batch_size=16"]),
    ([*TOGETHER, "trainer.devices=8", "data.n_held_out=4"], ["trainer.devices: got 8, more than the 2 samples"]),
    (["data=folder"], ["data.folder: missing", "data.folder=VALUE"]),
    (["+data.folder=photos"], ["data.folder: unknown key", "expected one of", "sensor_size"]),
    ([*FOLDER, "data.name=../x"], ["data.name", "'../x'"]),
    (["render", "data=folder"], [NOTHING_TO_RENDER]),
    (["render", "shard=4/4"], ["shard: got '4/4'; expected INDEX/COUNT with 0 <= INDEX < COUNT, such as 0/4"]),
    (["render", "+shards=0/2"], ["shards: unknown key"]),
    (["render", "masks=true"], ["masks: got True; expected the name of a folder"]),
]


@cache
def composed(verb: str, *groups: str) -> DictConfig:
    with hydra.initialize_config_dir(str(conf_folder()), version_base="1.3"):
        return hydra.compose("render" if verb == "render" else "config", ["preset=smoke", *groups])


def with_values(arguments: list[str]) -> tuple[str, DictConfig]:
    """The verb, and a configuration whose groups Hydra composes and whose values are put in as Hydra does."""
    words = arguments[arguments[0] == "render" :]
    parsed = OverridesParser.create().parse_overrides(words)
    is_group = [(conf_folder() / item.key_or_group).is_dir() for item in parsed]
    verb = "render" if arguments[0] == "render" else "train"
    config = deepcopy(composed(verb, *compress(words, is_group)))
    OmegaConf.set_struct(config, False)
    for item, chosen in zip(parsed, is_group, strict=True):
        if not chosen:
            OmegaConf.update(config, item.key_or_group, item.value())
    return verb, config


def require_sound(verb: str, config: DictConfig, runs: Path) -> None:
    """What a verb checks before it does anything."""
    if verb == "render":
        check_render(plain(config))
    else:
        require_possible(check(plain(config)), RunFolder(runs / "run"))


@pytest.mark.parametrize(("arguments", "parts"), WRONG_VALUES, ids=lambda value: " ".join(value)[:40])
def test_a_wrong_value_is_one_line(tmp_path: Path, arguments: list[str], parts: list[str]) -> None:
    verb, config = with_values(arguments)
    with pytest.raises(ConfigError) as refused:
        require_sound(verb, config, tmp_path)
    (line,) = str(refused.value).splitlines()
    assert all(part in line for part in parts), line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("verb", "model"), [("train", RunConfig), ("render", RenderConfig)])
@pytest.mark.parametrize("wrong", [[[1]], -(10**9)], ids=["another type", "below every range"])
def test_every_key_refuses_a_wrong_value(tmp_path: Path, verb: str, model: type[BaseModel], wrong: Any) -> None:
    """All at once: of every key that has no class of the user's choice a list, and of every number a negative one."""
    config = deepcopy(composed(verb))
    values = {key: value for key, value in flatten(plain(config)).items() if not key.startswith(OPEN)}
    known = [key for key in values if key.partition(".")[0] in model.model_fields]
    keys = [key for key in known if isinstance(wrong, list) or isinstance(values[key], int | float)]
    for key in keys:
        OmegaConf.update(config, key, wrong)
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

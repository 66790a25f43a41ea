"""A run's name contains every override that can change a number, and no other; `init=` keeps the network of a run."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

import phd_exp as package
from phd_exp.cli.train import announce, checked_start, run_name
from phd_exp.config import RunConfig, check
from phd_exp.records.errors import ConfigError, RunError
from phd_exp.records.runs import RunFolder
from tests.support.synthetic import write_run

Compose = Callable[..., dict[str, Any]]
SAME = [
    ("optimizer.lr=1e-3", "optimizer.lr=0.001"),
    ("data.occluders=true", "data.occluders=True"),
    ("data.f_range=[1, 2]", "data.f_range=[1,2]"),
    ("+optimizer.eps=1e-7", "++optimizer.eps=1e-7"),
]
"""Words for one value: a sweep rewrites the values of its runs."""


@pytest.fixture(scope="module")
def config(composed: Compose) -> RunConfig:
    return check(composed("preset=smoke"))


def test_the_name_contains_the_overrides_that_can_change_a_number(config: RunConfig) -> None:
    for override in (
        *("runs=elsewhere", "logger=none", "logger.project=mine", "data.name=mine", "data.root=/data"),
        *("data.workers=1", "trainer.progress_bar=false", "trainer.threads=1"),
    ):
        assert run_name(config, [override]).overrides == ()
    for override in (
        *("data.n_train=8", "data.folder=photos", "backbone=resnet50", "camera=constant", "optimizer.lr=0.1"),
        *("recipe.localisation=0", "trainer.precision=float32"),
    ):
        assert run_name(config, [override]).overrides == run_name(config, [f"+{override}"]).overrides == (override,)
    for one, other in SAME:
        assert run_name(config, [one]) == run_name(config, [other])


def test_an_equal_run_is_named_before_the_training(
    composed: Compose, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    base = ["preset=smoke", f"data.root={tmp_path}", f"runs={tmp_path}"]
    default = check(composed(*base))
    first = RunFolder(run_name(default, base).folder(tmp_path))
    with first.held(), first.recording(None):
        first.write_config(default.model_dump(mode="json"))
    for word, is_equal in (("optimizer.lr=0.001", True), ("trainer.threads=1", True), ("optimizer.lr=0.002", False)):
        checked = check(composed(*base, word))
        announce(checked, RunFolder(run_name(checked, [*base, word, "data.n_held_out=8"]).folder(tmp_path)), base)
        assert (f"{first.path} is finished, with an equal configuration" in capsys.readouterr().out) == is_equal
    (first.path / "config.yaml").write_text("[")
    announce(default, RunFolder(first.path.with_name("seed0-0")), base)
    assert "an equal configuration" not in capsys.readouterr().out


COSTLY = ["model=mae_logz", "data=scale"]
COST = "11000 images to render, then 50 epochs of resnet50 on 8000 images of 224 px"
CHEAP = "4200 images to render, then 30 epochs of resnet10 on 3200 images of 64 px, on the CPU"


@pytest.mark.parametrize(
    ("gpu", "typed", "cost", "lines"),
    [(True, COSTLY, COST, 1), (False, COSTLY, COST, 3), (False, ["preset=small"], CHEAP, 1)],
)
def test_a_run_first_prints_its_cost(
    composed: Compose, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path,
    gpu: bool, typed: list[str], cost: str, lines: int,
) -> None:  # fmt: skip
    monkeypatch.setattr("phd_exp.hardware.has_gpu", lambda accelerator: gpu)
    announce(check(composed(*typed, f"data.root={tmp_path}")), RunFolder(Path("runs/x")), typed)
    first, *rest = capsys.readouterr().out.splitlines()
    assert first.startswith(f"runs/x: {cost}")
    assert len(rest) == lines - 1
    if rest:
        assert rest[-1].endswith("python -m phd_exp model=mae_logz data=scale preset=small")


def test_one_word_instead_of_a_list_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"^overrides: got 'preset=smoke'; expected a list .*\['preset=smoke'\]$"):
        package.train("preset=smoke")


@pytest.fixture
def start(composed: Compose, tmp_path: Path) -> RunFolder:
    run = write_run(tmp_path, n=4)
    run.config_file.write_text(yaml.safe_dump(composed("recipe=strong", "recipe.hidden=8", "data.image_size=112")))
    return run


@pytest.mark.parametrize("typed", [(), ("preset=small", "optimizer=muon", "data=occl", "data.sensor_size=112")])
def test_the_network_and_its_inputs_are_those_of_the_run(
    composed: Compose, start: RunFolder, typed: tuple[str, ...]
) -> None:
    """Also where the images of the configuration would be larger than rendered."""
    config, recorded = composed(*typed, f"init={start.path}"), start.config()
    started = checked_start(config, list(typed)).model_dump()
    for section in ("backbone", "camera"):
        assert started[section] == recorded[section] != config[section]
    assert (started["recipe"]["hidden"], started["recipe"]["exposure"]) == (8, recorded["recipe"]["exposure"])
    assert started["data"]["image_size"] == 112
    assert (started["optimizer"], started["recipe"]["schedule"]) == (
        config["optimizer"],
        config["recipe"]["schedule"],
    )


@pytest.mark.parametrize(
    ("word", "value"),
    [("backbone=resnet18", 18), ("++backbone.depth=34", 34), ("camera=constant", "constant"), ("recipe.hidden=4", 4),
     ("data.image_size=64", 64)],
)  # fmt: skip
def test_what_the_command_line_names_is_not_changed(
    composed: Compose, start: RunFolder, word: str, value: object
) -> None:
    key = word.partition("=")[0].lstrip("+")
    key = {"backbone": "backbone.depth", "camera": "camera.focal_length"}.get(key, key)
    section, _, name = key.partition(".")
    found = checked_start(composed(word, f"init={start.path}"), [word]).model_dump()
    assert found[section][name] == value != start.config()[section].get(name)


def test_what_cannot_be_a_start_is_refused(composed: Compose, start: RunFolder) -> None:
    older = start.config()
    del older["recipe"]["hidden"]
    start.config_file.write_text(yaml.safe_dump(older))
    typed = f"init={start.path}"
    assert checked_start(composed("recipe.hidden=4", typed), []).recipe.hidden == 0, "the default of older records"
    start.config_file.write_text(yaml.safe_dump(older | {"backbone": {"_target_": "nowhere.Net"}}))
    with pytest.raises(ConfigError, match="is not of this project; name it by backbone=CHOICE"):
        checked_start(composed(typed), [])
    assert checked_start(composed(typed, "backbone=resnet18"), ["backbone=resnet18"])
    start.config_file.write_text("backbone: {}\ncamera: {}\nrecipe: 3\n")
    with pytest.raises(RunError, match="not the configuration of a run"):
        checked_start(composed(typed), [])

"""`init=` starts with the network of a finished run, except for what the command line names."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from phd_exp.cli.starts import checked_start, with_network_of
from phd_exp.config import check
from phd_exp.records.errors import ConfigError, RunError
from phd_exp.records.runs import RunFolder
from tests.support.synthetic import write_run


@pytest.fixture
def start(composed: Callable[..., dict[str, Any]], tmp_path: Path) -> RunFolder:
    run = write_run(tmp_path, n=4)
    run.config_file.write_text(yaml.safe_dump(composed("recipe=strong", "recipe.hidden=8", "data.image_size=112")))
    return run


@pytest.mark.parametrize("words", [(), ("preset=small", "optimizer=muon", "data=occl")])
def test_the_network_and_its_inputs_are_those_of_the_run(
    composed: Callable[..., dict[str, Any]], start: RunFolder, words: tuple[str, ...]
) -> None:
    config, recorded = composed(*words), start.config()
    changed = with_network_of(start, config, list(words))
    for section in ("backbone", "camera"):
        assert changed[section] == recorded[section] != config[section]
    recipe = recorded["recipe"]
    assert changed["recipe"] == config["recipe"] | {"hidden": 8, "exposure": recipe["exposure"]}
    assert changed["data"] == config["data"] | {"image_size": 112}
    assert all(changed[key] == config[key] for key in config.keys() - {"backbone", "camera", "recipe", "data"})
    check(changed)


@pytest.mark.parametrize(
    ("word", "section"),
    [("backbone=resnet50", "backbone"), ("++backbone.depth=34", "backbone"), ("camera=constant", "camera"),
     ("recipe.hidden=4", "recipe"), ("data.image_size=64", "data")],
)  # fmt: skip
def test_what_the_command_line_names_is_not_changed(
    composed: Callable[..., dict[str, Any]], start: RunFolder, word: str, section: str
) -> None:
    config = composed(word)
    changed = with_network_of(start, config, [word])
    if section in ("backbone", "camera"):
        assert changed[section] == config[section]
    else:
        key = word.partition("=")[0].partition(".")[2]
        assert changed[section][key] == config[section][key] != start.config()[section][key]


def test_images_are_no_larger_than_those_of_the_run(
    composed: Callable[..., dict[str, Any]], start: RunFolder
) -> None:
    words = ["recipe=strong", "data.sensor_size=112", f"init={start.path}"]
    config = composed(*words)
    with pytest.raises(ConfigError, match="image_size=224 is larger than sensor_size=112"):
        check(config)
    assert checked_start(config, words).data.image_size == 112


def test_older_records_have_the_defaults_of_keys_that_they_lack(
    composed: Callable[..., dict[str, Any]], start: RunFolder
) -> None:
    older = start.config()
    del older["recipe"]["hidden"]
    start.config_file.write_text(yaml.safe_dump(older))
    assert check(with_network_of(start, composed("recipe.hidden=4"), [])).recipe.hidden == 0


def test_what_cannot_be_a_start_is_refused(composed: Callable[..., dict[str, Any]], start: RunFolder) -> None:
    with pytest.raises(ConfigError, match="expected the folder of a finished run"):
        with_network_of(RunFolder(start.path / "nowhere"), composed(), [])
    foreign = start.config() | {"backbone": {"_target_": "nowhere.Net"}}
    start.config_file.write_text(yaml.safe_dump(foreign))
    with pytest.raises(ConfigError, match="is not of this project; name it by backbone=CHOICE"):
        with_network_of(start, composed(), [])
    assert with_network_of(start, composed("backbone=resnet18"), ["backbone=resnet18"])
    start.config_file.write_text("backbone: {}\ncamera: {}\nrecipe: 3\n")
    with pytest.raises(RunError, match="not the configuration of a run"):
        with_network_of(start, composed(), [])

"""What each choice of preset, recipe, data, model and backbone resolves to, and the folder of its run.

`golden.csv` has a line for each command line; an empty cell is null, or a key that the configuration lacks. The same
command must find the runs that earlier versions have trained, so a line changes only with the changelog.
"""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from phd_exp.cli import conf_folder
from phd_exp.cli.train import run_name
from phd_exp.config import check
from phd_exp.records.choices import flatten

with Path(__file__).with_name("golden.csv").open() as lines:
    GOLDEN = list(csv.DictReader(lines))
PRESETS = ["paper", "small", *(pytest.param(preset, marks=pytest.mark.slow) for preset in ("demo", "full", "smoke"))]
ABLATION = yaml.safe_load((conf_folder() / "experiment/ablation.yaml").read_text())["hydra"]["sweeper"]["each"]


@pytest.mark.parametrize("preset", PRESETS)
def test_every_combination_of_choices_has_its_values_and_its_folder(
    composed: Callable[..., dict[str, Any]], preset: str, tmp_path: Path
) -> None:
    (mesh := tmp_path / "part.obj").touch()
    for line in GOLDEN:
        words = line["words"].split()
        if words[0] == f"preset={preset}":
            config = composed(*words)
            found = {key: json.dumps(value).strip('"') for key, value in flatten(config).items() if value is not None}
            expected = {key: value for key, value in line.items() if key not in ("words", "run")}
            assert {key: found.get(key, "") for key in expected} == expected, line["words"]
            own = {"mesh": str(mesh)} if "data=object" in words else {}
            checked = check(config | {"data": config["data"] | own})
            assert str(run_name(checked, words).folder(checked.runs)) == line["run"]


def test_an_ablation_changes_what_the_strong_recipe_sets(composed: Callable[..., dict[str, Any]]) -> None:
    whole, paper = (flatten(composed("preset=small", f"recipe={name}")) for name in ("strong", "paper"))
    parts: set[str] = set()
    for overrides in filter(None, ABLATION):
        without = flatten(composed("preset=small", "recipe=strong", *overrides))
        changed = {key for key in whole | without if whole.get(key) != without.get(key)}
        assert changed, overrides
        parts |= changed
    of_recipe = {key for key in whole | paper if whole.get(key) != paper.get(key)} - {"recipe.name"}
    # the class of the network, whose parts are left out; its points, which only data=object has; and the learning
    # rate of both optimizers
    assert of_recipe - parts == {"backbone._target_", "backbone.points", "optimizer.lr"}

"""Config nodes that name a class: what they may name, and whether their keys fit."""

import json
from typing import Any

import pytest
from pydantic_core import PydanticCustomError

from phd_exp.config.targets import Trust, check_target, custom_parts

ADAM = "torch.optim.Adam"
HEAD = "phd_exp.models.heads.ChartHead"
CHART = {"_target_": "phd_exp.geometry.charts.Cartesian", "_partial_": True}

GOOD: list[dict[str, Any]] = [
    {"_target_": ADAM},
    {"_target_": ADAM, "lr": 0.1, "betas": [0.9, 0.99]},
    {"_target_": "phd_exp.models.heads.ChartHead", "chart": CHART},
    {"_target_": "phd_exp.models.backbones.resnet", "depth": 18},
]
BAD: list[tuple[dict[str, Any], str]] = [
    ({"lr": 1.0}, r"^_target_: got None; expected MODULE.NAME"),
    ({"_target_": "phd_exp.models.nothing.There"}, r"cannot be imported"),
    ({"_target_": "phd_exp.models.heads.Nothing"}, r"cannot be imported \(module .* has no attribute 'Nothing'\)"),
    ({"_target_": "phd_exp.models.heads.__name__"}, r"is a str; expected a class or function"),
    ({"_target_": HEAD, "depht": 1.0}, r"^depht: unknown key, did you mean 'depth'\?; .*ChartHead takes"),
    ({"_target_": "phd_exp.models.backbones.resnet", "depth": "deep"}, r"^depth: got 'deep'; expected to be 10, 18"),
    ({"_target_": "phd_exp.models.backbones.resnet", "depth": 7}, r"^depth: got 7; expected to be 10, 18, 34 or 50"),
    ({"_target_": HEAD, "chart": CHART | {"unit": 1}}, r"^chart\.unit: unknown key"),
]
FOREIGN: list[tuple[dict[str, Any], str]] = [
    ({"_target_": "builtins.eval"}, r"^_target_: 'builtins.eval' is not built from .*; .* add trust=builtins"),
    ({"_target_": ADAM}, r"^_target_: 'torch.optim.Adam' is not built"),
    ({"_target_": "phd_exp.records.files.write_atomic"}, r"is not built from a stored configuration$"),
    ({"_target_": "phd_exp.models.heads.Gone"}, r"no attribute 'Gone'\); use the version of phd_exp that recorded"),
    ({"_target_": "phd_exp.models_of_mine.Net"}, r"is not built from a stored configuration$"),
    ({"_target_": "phd_exp.geometry.camera.dataclass"}, r"is only imported there"),
    ({"_target_": HEAD, "chart": [{"_target_": "os.system"}]}, r"^chart\.0\._target_: 'os.system' is not"),
    ({"_target_": HEAD, "chart": {"deep": {"_target_": "os.system"}}}, r"^chart\.deep\._target_: 'os.system' is not"),
    ({"_target_": HEAD, "chart": CHART | {"_target_": "os.system"}}, r"^chart\._target_: 'os.system' is not"),
]


@pytest.mark.parametrize("node", GOOD, ids=str)
def test_accepts_what_fits(node: dict[str, Any]) -> None:
    assert check_target(node, None) == check_target(node, ("torch",)) == node


@pytest.mark.parametrize(("node", "said"), BAD, ids=str)
@pytest.mark.parametrize("trust", [None, (), ("torch", "os")])
def test_names_what_does_not(node: dict[str, Any], said: str, trust: Trust) -> None:
    with pytest.raises(PydanticCustomError, match=said):
        check_target(node, trust)


@pytest.mark.parametrize(("node", "said"), FOREIGN, ids=str)
@pytest.mark.parametrize("trust", [(), ("numpy", "torch.nn")])
def test_what_is_stored_builds_our_own_parts_alone(node: dict[str, Any], said: str, trust: Trust) -> None:
    with pytest.raises(PydanticCustomError, match=said):
        check_target(node, trust)


def test_trust_is_given_to_packages() -> None:
    node = {"_target_": "torch.nn.Flatten"}
    assert check_target(node, ("torch.nn",)) == node
    with pytest.raises(PydanticCustomError, match="is not built"):
        check_target(node, ("torch.nn.Flat", "torc"))


def test_any_keyword_fits_a_function_of_any_keywords() -> None:
    assert check_target({"_target_": "builtins.dict", "anything": 1}, None)
    for key in ("_recursive_", "_convert_", "_args_"):  # Hydra would read them, and build other objects
        with pytest.raises(PydanticCustomError, match=f"^{key}: unknown key"):
            check_target({"_target_": "builtins.dict", key: None}, None)


def test_custom_parts_are_listed_with_their_files() -> None:
    config = {"a": {"_target_": HEAD}, "b": [{"_target_": "json.dumps"}], "c": {"d": {"_target_": "builtins.dict"}}}
    found = custom_parts(config)
    assert found.keys() == {"json.dumps", "builtins.dict"}
    assert found["json.dumps"] == json.__file__
    assert found["builtins.dict"] == "built in"

"""Config nodes that name a class: what they may name, and whether their keys fit."""

from typing import Any, get_args

import pytest
from pydantic_core import PydanticCustomError

from phd_exp.training.config.targets import Origin, check_target

ADAM = "torch.optim.Adam"
CHART = {"_target_": "phd_exp.geometry.charts.Cartesian", "_partial_": True}

GOOD: list[dict[str, Any]] = [
    {"_target_": ADAM},
    {"_target_": ADAM, "lr": 0.1, "betas": [0.9, 0.99]},
    {"_target_": "phd_exp.models.heads.ChartHead", "chart": CHART},
    {"_target_": "phd_exp.models.backbones.resnet", "depth": 18},
]
BAD: list[tuple[dict[str, Any], str]] = [
    ({"lr": 1.0}, r"^_target_: None may not be built"),
    ({"_target_": "builtins.eval"}, r"^_target_: 'builtins.eval' may not be built"),
    ({"_target_": "torch.hub.load"}, r"^_target_: 'torch.hub.load' may not be built"),
    ({"_target_": "torchvision.models.get_model"}, r"may not be built|is no part of a network"),
    ({"_target_": "phd_exp.records.files.write_atomic"}, r"may not be built"),
    ({"_target_": "phd_exp.geometry.virtual.dataclass"}, r"is no class or function of its own"),
    ({"_target_": "phd_exp.geometry.charts.math"}, r"is no class or function of its own"),
    ({"_target_": ADAM, "betas": [{"_target_": "os.system"}]}, r"^betas\.0\._target_: 'os.system' may not"),
    ({"_target_": ADAM, "lr": {"deep": {"_target_": "os.system"}}}, r"^lr\.deep\._target_: 'os.system' may not"),
    ({"_target_": "phd_exp.models.nothing.There"}, r"does not exist"),
    ({"_target_": ADAM, "lrr": 1.0}, r"^lrr: unknown key, did you mean 'lr'\?; torch.optim.Adam takes params"),
    ({"_target_": ADAM, "lr": "fast"}, r"^lr: got 'fast'; expected a valid number"),
    ({"_target_": "phd_exp.models.backbones.resnet", "depth": 7}, r"^depth: got 7; expected to be 10, 18, 34 or 50"),
    ({"_target_": "phd_exp.models.heads.ChartHead", "chart": CHART | {"unit": 1}}, r"^chart\.unit: unknown key"),
    (
        {"_target_": "phd_exp.models.heads.ChartHead", "chart": CHART | {"_target_": "os.system"}},
        r"^chart\._target_: 'os.system' may not be built",
    ),
]


@pytest.mark.parametrize("node", GOOD, ids=str)
def test_accepts_what_fits(node: dict[str, Any]) -> None:
    assert check_target(node, "typed") == check_target(node, "stored") == node


@pytest.mark.parametrize(("node", "said"), BAD, ids=str)
@pytest.mark.parametrize("origin", get_args(Origin))
def test_names_what_does_not(node: dict[str, Any], said: str, origin: Origin) -> None:
    with pytest.raises(PydanticCustomError, match=said):
        check_target(node, origin)


@pytest.mark.parametrize("network", ["torchvision.models.segmentation.fcn_resnet50", "torch.nn.Flatten"])
def test_what_is_stored_builds_our_own_parts_alone(network: str) -> None:
    node = {"_target_": "phd_exp.models.backbones.PooledFeatures", "network": {"_target_": network}, "n_features": 1}
    for inner in (node, node["network"]):
        assert check_target(inner, "typed") == inner  # type: ignore[arg-type]
        with pytest.raises(PydanticCustomError, match="may not be built from a stored configuration"):
            check_target(inner, "stored")  # type: ignore[arg-type]

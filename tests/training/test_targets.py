"""Config nodes that name a class: what they may name, and whether their keys fit."""

from typing import Any

import pytest
from pydantic_core import PydanticCustomError

from phd_exp.training.config.targets import check_target, locate

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
    ({"_target_": "phd_exp.records.files.write_atomic"}, r"may not be built"),
    ({"_target_": "phd_exp.geometry.virtual.dataclass"}, r"is no class or function of its own"),
    ({"_target_": "phd_exp.geometry.charts.math"}, r"is no class or function of its own"),
    ({"_target_": ADAM, "betas": [{"_target_": "os.system"}]}, r"^betas\.0\._target_: 'os.system' may not"),
    (
        {"_target_": ADAM, "lr": {"deep": {"_target_": "os.system"}}},
        r"^lr\.deep\._target_: 'os.system' may not",
    ),
    ({"_target_": "phd_exp.models.nothing.There"}, r"does not exist"),
    (
        {"_target_": ADAM, "lrr": 1.0},
        r"^lrr: unknown key, did you mean 'lr'\?; torch.optim.Adam takes params",
    ),
    ({"_target_": ADAM, "lr": "fast"}, r"^lr: got 'fast'; expected a valid number"),
    (
        {"_target_": "phd_exp.models.backbones.resnet", "depth": 7},
        r"^depth: got 7; expected to be 10, 18, 34 or 50",
    ),
    (
        {"_target_": "phd_exp.models.heads.ChartHead", "chart": CHART | {"unit": 1}},
        r"^chart\.unit: unknown key",
    ),
    (
        {"_target_": "phd_exp.models.heads.ChartHead", "chart": CHART | {"_target_": "os.system"}},
        r"^chart\._target_: 'os.system' may not be built",
    ),
]


@pytest.mark.parametrize("node", GOOD, ids=str)
def test_accepts_what_fits(node: dict[str, Any]) -> None:
    assert check_target(node) == node


@pytest.mark.parametrize(("node", "said"), BAD, ids=str)
def test_names_what_does_not(node: dict[str, Any], said: str) -> None:
    with pytest.raises(PydanticCustomError, match=said):
        check_target(node)


def test_locates_classes() -> None:
    from torch.optim import Adam

    assert locate(ADAM, "") is Adam

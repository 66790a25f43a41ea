"""Precision follows the hardware unless it is named."""

import pytest
import torch

from phd_exp.training import network
from phd_exp.training.config import TrainerConfig


def config(precision: str, accelerator: str = "cpu") -> TrainerConfig:
    return TrainerConfig.model_validate(
        {
            "max_epochs": 1,
            "devices": 1,
            "accelerator": accelerator,
            "precision": precision,
            "threads": None,
            "progress_bar": False,
        }
    )


@pytest.mark.parametrize(("named", "lightning"), [("float32", "32-true"), ("bfloat16", "bf16-mixed")])
def test_a_named_precision_is_taken(named: str, lightning: str) -> None:
    assert network.precision(config(named)) == lightning


@pytest.mark.parametrize(("has_units", "lightning"), [(True, "bf16-mixed"), (False, "32-true")])
def test_bfloat16_only_where_the_cpu_has_units_for_it(
    monkeypatch: pytest.MonkeyPatch, has_units: bool, lightning: str
) -> None:
    monkeypatch.setattr(network, "cpu_has_bfloat16", lambda: has_units)
    assert network.precision(config("auto")) == lightning


@pytest.mark.parametrize(("has_units", "lightning"), [(True, "bf16-mixed"), (False, "32-true")])
def test_bfloat16_only_where_the_gpu_has_units_for_it(
    monkeypatch: pytest.MonkeyPatch, has_units: bool, lightning: str
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: has_units)
    assert network.precision(config("auto", "auto")) == lightning

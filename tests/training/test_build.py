"""The parts that a configuration names: precision, learning rate, curves, and values that are refused."""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from phd_exp import build, hardware
from phd_exp.config import RunConfig, check
from phd_exp.config.sections import EvaluationConfig
from phd_exp.data.backdrops import BACKDROP_NUMBERS, Backdrops, before_others
from phd_exp.data.batches import Batch, BatchLoader, Exchange
from phd_exp.data.images import SHRINKING
from phd_exp.data.photometry import VERSION
from phd_exp.data.prints import PRINT_NUMBERS, printed
from phd_exp.records.errors import ConfigError, RunError
from phd_exp.records.runs import RunFolder
from phd_exp.training import tables
from phd_exp.training.build import build_data, build_module
from phd_exp.training.objective import factor
from phd_exp.training.recorder import has_curves
from phd_exp.training.train import require_same_photometry


def arithmetic(config: RunConfig) -> str:
    return hardware.precision(config.trainer.accelerator, config.trainer.precision)


@pytest.fixture
def checked(composed: Callable[..., dict[str, Any]]) -> Callable[..., RunConfig]:
    return lambda *overrides: check(composed("preset=smoke", *overrides))


@pytest.mark.parametrize(("has_units", "expected"), [(True, "bf16-mixed"), (False, "32-true")])
def test_bfloat16_only_on_hardware_with_units_for_it(
    checked: Callable, monkeypatch: pytest.MonkeyPatch, has_units: bool, expected: str
) -> None:
    monkeypatch.setattr(hardware, "cpu_has_bfloat16", lambda: has_units)
    assert arithmetic(checked("trainer=cpu")) == expected
    monkeypatch.setattr(hardware, "cpu_has_bfloat16", lambda: not has_units)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: has_units)
    assert arithmetic(checked("trainer=auto")) == expected


@pytest.mark.parametrize("loss", ["localisation", "segmentation"])
def test_the_losses_of_a_map_require_a_backbone_that_has_one(checked: Callable, loss: str) -> None:
    config = checked(f"recipe.{loss}=1")
    with pytest.raises(ConfigError, match=rf"^recipe\.{loss}: got 1\.0, but this backbone has no map of the object"):
        build_module(config, build_data(config))


def test_the_learning_rate_rises_linearly_and_falls_as_half_a_wave() -> None:
    at = factor("cosine", 9, 1000)
    found = [at(step) for step in (0, 4, 9, 500, 1000)]
    assert found == pytest.approx([0.1, 0.5, 1, 0.5, 0], rel=1e-3, abs=1e-12)
    assert at(1001) == at(1000)  # Lightning asks for a step after the last
    falling = [at(step) for step in range(10, 1000)]
    assert falling == sorted(falling, reverse=True)


@pytest.mark.parametrize("side", [64, 112])
@pytest.mark.parametrize("version", [None, SHRINKING - 1, SHRINKING])
@pytest.mark.parametrize("begun", [True, False])
def test_images_shrunk_by_another_version_are_refused_where_they_differ(
    checked: Callable, tmp_path: Path, side: int, version: int | None, begun: bool
) -> None:
    folder = RunFolder(tmp_path)
    folder.checkpoints.mkdir()
    if begun:
        folder.last_checkpoint.touch()
    if version is not None:
        folder.write_constants({"shrinking": version})
    config = checked("data.sensor_size=224", f"data.image_size={side}")
    refused = begun and side == 64 and version != SHRINKING
    with pytest.raises(RunError, match="shrunk from 224 to 64 pixels") if refused else nullcontext():
        build.require_same_shrinking(folder, config.data)


@pytest.mark.parametrize("words", [["photometry=robust"], ["recipe=strong"]], ids=" ".join)
@pytest.mark.parametrize("version", [None, 2, VERSION])
@pytest.mark.parametrize("state", ["new", "interrupted", "finished"])
def test_a_run_with_photometry_of_another_version_is_not_resumed(
    checked: Callable, tmp_path: Path, words: list[str], version: int | None, state: str
) -> None:
    folder = RunFolder(tmp_path)
    folder.checkpoints.mkdir()
    with folder.recording(None) if state == "finished" else nullcontext():
        pass
    if state != "new":
        folder.last_checkpoint.touch()
    folder.write_constants({"photometry": version} if version else {})
    refused = state == "interrupted" and words == ["photometry=robust"] and version != VERSION
    with pytest.raises(RunError, match="move the folder away and train again") if refused else nullcontext():
        require_same_photometry(folder, checked(*words).recipe)


def test_shifted_images_are_recorded_again_with_another_version_of_photometry(
    checked: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, config = RunFolder(tmp_path), checked("shift=[images,focal_length]")
    names = set(config.evaluation.shifts)
    before = {name: tables.origin_of_shift(folder, config, name) for name in names}
    monkeypatch.setattr(tables, "VERSION", VERSION + 1)
    changed = {name for name in names if tables.origin_of_shift(folder, config, name) != before[name]}
    assert changed == names - {"f_wrong"}


READS = ("aten::_local_scalar_dense", "aten::nonzero", "aten::is_nonzero", "aten::equal")
"""Operations whose result the host reads, for which it waits for a GPU."""


class Reads(TorchDispatchMode):
    """Counts them."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.found += [function.name()] * (function.name() in READS)
        return function(*args, **(kwargs or {}))


@pytest.mark.parametrize(
    "words",
    [
        *([], ["camera.f_error=0.05"], ["model=mae_constf"], ["model=student_t"]),
        ["recipe.augmentation.largest_zoom=1.2"],
    ],
    ids=" ".join,
)
def test_a_training_step_and_its_data_read_nothing_back(checked: Callable, words: list[str]) -> None:
    config = checked("recipe=strong", "photometry=robust", "backbone.width=8", "backbone.channels=4", *words)
    data = build_data(config)
    module, n = build_module(config, data), 4
    optimizer = module.optimizer(module.regressor.parameters())
    image, mask = torch.zeros(n, 64, 64, 3, dtype=torch.uint8), torch.zeros(n, 28, 28, dtype=torch.uint8)
    batch = Batch(
        image, torch.tensor([[0.0, 0.0, 4.0]]).expand(n, 3), torch.full((n,), 400.0), 64.0, torch.arange(n), mask
    )
    limits = {"contrast": 2.0, "white_balance": 1.5, "occluders": 1.0}
    augment = replace(data.augment, photometry=replace(data.augment.photometry, **limits))
    backdrops = Backdrops(image, mask.new_zeros(n, 64, 64))
    augment = Exchange(backdrops, printed, PRINT_NUMBERS, 1.0, augment)
    augment = Exchange(backdrops, partial(before_others, plain=0.5), BACKDROP_NUMBERS, 1.0, augment)
    loader = BatchLoader(batch, n, shuffle=True, seed=0, augment=augment)
    assert len(backdrops.texture) == n  # computed once, before the first step
    with Reads() as reads:
        (first,) = loader
        changed = augment(first, torch.full((n, augment.n_numbers), 0.9, dtype=torch.float64))  # all of it
        module.training_step(changed, 0).backward()
        optimizer.step()
        assert reads.found == []
        bool(batch.xyz.isfinite().all())
        assert reads.found == [READS[0]]


@pytest.mark.parametrize("wanted", [1, 2, 7, 10])
@pytest.mark.parametrize("every", [1, 2, 3, 4, 5, 10, 22])
def test_curves_are_those_of_the_evaluations_nearest_to_the_wanted_epochs(wanted: int, every: int) -> None:
    evaluation = EvaluationConfig(calibration_window=200, calibration_every_n_epochs=wanted, every_n_epochs=every)
    evaluated = range(every, 400, every)
    nearest = {
        min(evaluated, key=lambda epochs: (abs(epochs - at), epochs))
        for at in range(wanted, 300, wanted)
        if Fraction(at, every) > Fraction(1, 2)  # else nearer to the untrained network
    }
    found = {epochs for epochs in evaluated if has_curves(epochs, evaluation)}
    assert {epochs for epochs in found if epochs < 250} == {epochs for epochs in nearest if epochs < 250}
    if wanted % every == 0:
        assert found == {epochs for epochs in evaluated if epochs % wanted == 0}

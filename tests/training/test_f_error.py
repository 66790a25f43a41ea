"""A focal length that is known within some per cent: the errors that the model receives."""

from collections.abc import Callable

import pytest
import torch
from scipy.stats import kstest

from phd_exp.data.batches import Batch
from phd_exp.records.errors import ConfigError
from phd_exp.training.build import build_data, build_module
from phd_exp.training.config import check
from phd_exp.training.module import standard_error

ROWS = torch.arange(8000)


def test_the_errors_are_normal_over_the_samples_of_an_epoch_and_over_the_epochs_of_a_sample() -> None:
    for epoch in (0, 7, 49):
        assert kstest(standard_error(ROWS, epoch), "norm").statistic < 0.01
    for row in (0, 13, 7999):
        over_epochs = torch.stack([standard_error(ROWS[row : row + 1], epoch) for epoch in range(50)])
        assert kstest(over_epochs.flatten(), "norm").statistic < 0.05


def test_the_errors_of_an_epoch_do_not_follow_the_order_of_the_samples() -> None:
    shares = standard_error(ROWS, 3)
    assert abs(float(torch.corrcoef(torch.stack([shares, ROWS.float()]))[0, 1])) < 0.01


def test_the_model_receives_focal_lengths_within_the_error_and_the_labels_stay(composed: Callable) -> None:
    config = check(composed("preset=smoke", "camera.f_error=0.05"))
    module = build_module(config, build_data(config))
    n = 64
    xyz = torch.tensor([0.1, 0.0, 4.0]).expand(n, 3)
    batch = Batch(torch.zeros(n, 8, 8, 3, dtype=torch.uint8), xyz, torch.full((n,), 1500.0), 8.0, torch.arange(n))
    known = module.eval().camera(batch).f
    assert (known / 1500).log().std() == pytest.approx(0.05, rel=0.15)
    assert (known / 1500).log().mean() == pytest.approx(0, abs=0.01)
    assert torch.equal(known, module.eval().camera(batch).f)
    assert torch.equal(batch.camera.f, torch.full((n,), 1500.0))
    shifted = batch.select(torch.arange(32, n))
    assert torch.equal(module.camera(shifted).f, known[32:])  # by sample, in whatever batch


def test_an_error_of_a_focal_length_that_is_not_used_is_refused(composed: Callable) -> None:
    with pytest.raises(ConfigError, match=r"^camera: f_error: got 0\.1; camera=constant uses no focal length"):
        check(composed("preset=smoke", "camera=constant", "camera.f_error=0.1"))

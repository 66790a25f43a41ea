"""Calibration curves against a plain loop, and on samples whose calibration is known."""

import numpy as np
import pytest
import torch

from phd_exp.metrics.calibration import calibration_curve


def samples(n: int, overconfidence: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Predicted variances over three decades, and squared errors `overconfidence` times as large on average."""
    generator = torch.Generator().manual_seed(1)
    variance = 10 ** (3 * torch.rand(n, generator=generator, dtype=torch.float64))
    return variance, overconfidence * variance * torch.randn(
        n, generator=generator, dtype=torch.float64
    ).square()


def test_equals_a_sliding_mean() -> None:
    variance, error = samples(500, 1.0)
    curve = calibration_curve(variance, error, window=100)
    order = np.argsort(variance.numpy(), kind="stable")
    kernel = np.ones(100) / 100
    np.testing.assert_allclose(curve.predicted, np.convolve(variance.numpy()[order], kernel, "valid"))
    np.testing.assert_allclose(curve.empirical, np.convolve(error.numpy()[order], kernel, "valid"))
    assert curve.window == 100


@pytest.mark.parametrize("overconfidence", [0.5, 1.0, 2.0, 10.0])
def test_shows_how_overconfident_a_model_is(overconfidence: float) -> None:
    curve = calibration_curve(*samples(20_000, overconfidence), window=2000)
    ratio = curve.empirical / curve.predicted
    assert ratio.median().item() == pytest.approx(overconfidence, rel=0.1)


@pytest.mark.parametrize(("n", "window"), [(1, 1), (4, 1), (16, 3), (999, 199), (1000, 200)])
def test_a_small_set_narrows_the_window(n: int, window: int) -> None:
    curve = calibration_curve(*samples(n, 1.0), window=200)
    assert curve.window == window
    assert len(curve.predicted) == len(curve.empirical) == n - window + 1


def test_does_not_lose_small_variances_beside_large_ones() -> None:
    variance = torch.tensor([1e-12] * 10 + [1e12] * 10, dtype=torch.float64)
    curve = calibration_curve(variance, variance, window=2)
    assert curve.predicted[0].item() == pytest.approx(1e-12)


def test_what_is_not_finite_is_left_out_and_counted() -> None:
    variance, error = samples(100, 1.0)
    whole = calibration_curve(variance, error, window=10)
    assert whole.left_out == 0
    broken = torch.cat([variance, torch.tensor([torch.inf, 1.0, torch.nan])])
    with_broken = torch.cat([error, torch.tensor([1.0, torch.nan, 1.0])])
    curve = calibration_curve(broken, with_broken, window=10)
    assert curve.left_out == 3
    torch.testing.assert_close(curve.predicted, whole.predicted)
    torch.testing.assert_close(curve.empirical, whole.empirical)


@pytest.mark.parametrize("bad", [[], [float("nan")], [float("inf")]])
def test_refuses_what_has_no_curve(bad: list[float]) -> None:
    values = torch.tensor(bad, dtype=torch.float64)
    with pytest.raises(ValueError, match="calibration curve needs"):
        calibration_curve(values, values, window=200)

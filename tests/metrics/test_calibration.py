"""Measures of calibration against plain loops, scipy and uncertainty-toolbox, and known answers."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
import uncertainty_toolbox as uct
from scipy import stats

from phd_exp.metrics.calibration import (
    calibration_curve,
    coverage,
    ence_of,
    miscalibration_area,
    overconfidence,
    uniform_distance,
)
from phd_exp.metrics.ordered import in_order_of


def samples(n: int, overconfidence: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Predicted variances over three decades, and squared errors `overconfidence` times as large on average."""
    generator = torch.Generator().manual_seed(1)
    variance = 10 ** (3 * torch.rand(n, generator=generator, dtype=torch.float64))
    noise = torch.randn(n, generator=generator, dtype=torch.float64)
    return variance, overconfidence * variance * noise.square()


def ence(variance: torch.Tensor, squared_error: torch.Tensor, bins: int) -> torch.Tensor:
    """The expected normalised calibration error of samples in any order."""
    ordered = in_order_of(variance, {"variance": variance, "squared_error": squared_error})
    return ence_of(ordered, "variance", "squared_error", bins)


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


def test_small_variances_keep_their_digits_next_to_large_ones() -> None:
    variance = torch.tensor([1e-12] * 10 + [1e12] * 10, dtype=torch.float64)
    curve = calibration_curve(variance, variance, window=2)
    assert curve.predicted[0].item() == pytest.approx(1e-12)


def test_samples_that_are_not_finite_are_left_out_and_counted() -> None:
    variance, error = samples(100, 1.0)
    whole = calibration_curve(variance, error, window=10)
    broken = torch.cat([variance, torch.tensor([torch.inf, 1.0, torch.nan])])
    with_broken = torch.cat([error, torch.tensor([1.0, torch.nan, 1.0])])
    curve = calibration_curve(broken, with_broken, window=10)
    assert (whole.left_out, curve.left_out) == (0, 3)
    torch.testing.assert_close(curve.predicted, whole.predicted)
    torch.testing.assert_close(curve.empirical, whole.empirical)
    for nothing in (broken[100:101], broken[102:], broken[:0]):
        with pytest.raises(ValueError, match="calibration curve needs"):
            calibration_curve(nothing, nothing, window=200)


def uniform(n: int, power: float = 1.0, seed: int = 3) -> torch.Tensor:
    """Levels that are uniform for power 1, too high for smaller and too low for larger powers."""
    return torch.rand(n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) ** power


@pytest.mark.parametrize(("n", "bins"), [(1000, 10), (1003, 10), (57, 4), (3, 5), (40, 1)])
def test_ence_equals_a_loop_over_bins(n: int, bins: int) -> None:
    variance, error = samples(n, 2.0)
    order = np.argsort(variance.numpy())
    place = np.floor(bins * (np.arange(n) + 0.5) / n).astype(int)
    gaps = []
    for chosen in (order[place == k] for k in range(bins)):
        if len(chosen):
            rmv, rmse = np.sqrt(variance.numpy()[chosen].mean()), np.sqrt(error.numpy()[chosen].mean())
            gaps += [abs(rmv - rmse) / rmv] * len(chosen)
    assert ence(variance, error, bins).item() == pytest.approx(np.mean(gaps), rel=1e-12)


@pytest.mark.parametrize("overconfidence", [0.25, 1.0, 4.0])
def test_ence_is_how_far_the_ratio_of_deviations_is_from_one(overconfidence: float) -> None:
    """|1 - sqrt(overconfidence)|; where calibrated, what scatter leaves of Gaussian errors."""
    value = ence(*samples(50_000, overconfidence), bins=10).item()
    scatter = 0.4 * np.sqrt(2 * 10 / 50_000)
    assert value == pytest.approx(abs(1 - overconfidence**0.5), abs=3 * scatter)


def test_ence_of_ties_does_not_depend_on_the_order_of_rows() -> None:
    variance, error = torch.tensor([1.0, 1.0, 1.0, 1.0]), torch.tensor([0.0, 0.0, 4.0, 4.0])
    assert ence(variance, error, bins=2).item() == pytest.approx(2**0.5 - 1)
    assert ence(variance, error.flip(0), bins=2) == ence(variance, error, bins=2)
    with pytest.raises(ValueError, match="bins must be at least 1"):
        ence(variance, error, 0)


def test_coverage_is_the_empirical_cdf() -> None:
    levels, at = uniform(500), torch.tensor([0.0, 0.25, 0.5, 0.99, 1.0], dtype=torch.float64)
    expected = stats.ecdf(levels.numpy()).cdf.evaluate(at.numpy())
    np.testing.assert_allclose(coverage(levels, at), expected, atol=1e-12)
    torch.testing.assert_close(coverage(levels, levels.sort().values), torch.arange(1, 501).double() / 500)


@pytest.mark.parametrize("power", [0.3, 1.0, 4.0])
def test_miscalibration_area_is_the_integral(power: float) -> None:
    """By a fine grid, and for many levels by hand: int |p^(1/power) - p| dp."""
    p = (torch.arange(200_000, dtype=torch.float64) + 0.5) / 200_000
    for levels in (uniform(400, power), torch.tensor([0.0, 1.0]).double(), torch.tensor([power / 4]).double()):
        by_grid = (coverage(levels, p) - p).abs().mean().item()
        assert miscalibration_area(levels).item() == pytest.approx(by_grid, abs=1e-5)
    by_hand = abs(power / (1 + power) - 0.5)
    assert miscalibration_area(uniform(200_000, power)).item() == pytest.approx(by_hand, abs=3e-3)


@pytest.mark.parametrize("power", [0.3, 1.0, 4.0])
def test_overconfidence_has_a_sign(power: float) -> None:
    """The mean of u^power is 1/(1 + power); where all coverage is on one side it is the area."""
    levels = uniform(100_000, power)
    assert overconfidence(levels).item() == pytest.approx(1 / (1 + power) - 0.5, abs=3e-3)
    if power != 1:
        assert abs(overconfidence(levels).item()) == pytest.approx(miscalibration_area(levels).item(), abs=1e-4)


@pytest.mark.parametrize("power", [0.8, 1.0, 1.02])
@pytest.mark.parametrize("n", [5, 300, 2000])
def test_the_distance_from_uniform_is_scipys(power: float, n: int) -> None:
    levels = uniform(n, power)
    expected = stats.kstest(levels.numpy(), "uniform").statistic
    assert uniform_distance(levels).item() == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
def test_agrees_with_uncertainty_toolbox(scale: float) -> None:
    """Gaussian predictions whose deviation is `scale` times the true one; its curves have 100 points."""
    generator = np.random.default_rng(4)
    deviation = generator.uniform(0.5, 2, 3000)
    mean, truth = generator.normal(size=(2, 3000))
    truth = mean + deviation * truth
    standard = (truth - mean) / (scale * deviation)
    level = torch.from_numpy(2 * stats.norm.cdf(np.abs(standard)) - 1)
    pit = torch.from_numpy(stats.norm.cdf(-standard))  # it counts predicted minus true
    for levels, kind in ((level, "interval"), (pit, "quantile")):
        arguments = (mean, scale * deviation, truth)
        p, share = uct.get_proportion_lists_vectorized(*arguments, num_bins=100, prop_type=kind)
        np.testing.assert_allclose(coverage(levels, torch.from_numpy(p)), share, atol=1e-3)
        area = uct.miscalibration_area(*arguments, num_bins=100, vectorized=True, prop_type=kind)
        assert miscalibration_area(levels).item() == pytest.approx(area, abs=1e-3)


MEASURES = (
    *(miscalibration_area, overconfidence, uniform_distance),
    *(lambda x: ence(x, x, 3), lambda x: coverage(x, torch.ones(1))),
)


@pytest.mark.parametrize("bad", [[], [0.5, float("nan")], [float("inf")]])
@pytest.mark.parametrize("measure", MEASURES)
def test_samples_that_are_not_finite_are_refused(measure: Callable, bad: list[float]) -> None:
    with pytest.raises(ValueError, match=rf"samples: got {len(bad)}, .* expected at least one, all finite"):
        measure(torch.tensor(bad, dtype=torch.float64))

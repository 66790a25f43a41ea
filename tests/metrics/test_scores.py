"""Every score against a loop or a library, and one list of laws for all: order, ties, weights, dtype, bad values."""

import math
from collections.abc import Callable, Mapping

import numpy as np
import pytest
import torch
import uncertainty_toolbox as uct
from scipy import stats
from torch import Tensor

from phd_exp.metrics.calibration import calibration_curve, coverage, ence_of, miscalibration_area, overconfidence
from phd_exp.metrics.calibration_scores import (
    COLUMNS,
    abscissae,
    calibration_scores,
    curves,
    ence_bins,
    exact_scores,
    ordered,
)
from phd_exp.metrics.ordered import in_order_of
from phd_exp.metrics.scores import energy_score, risk_at

Arrays = Mapping[str, np.ndarray]


def columns(n: int, seed: int = 0, digits: int = 9) -> dict[str, Tensor]:
    """Samples whose variances cover three decades and whose errors are twice too large; few digits give many ties."""
    u = torch.rand(len(COLUMNS), n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    noise = torch.randn(2, n, generator=torch.Generator().manual_seed(seed + 1), dtype=torch.float64)
    table = dict(zip(COLUMNS, u, strict=True))
    for name, z in zip(("depth", "projected"), noise, strict=True):
        table[f"{name}_variance"] = 10 ** (3 * table[f"{name}_variance"])
        table[f"{name}_squared_error"] = 2 * table[f"{name}_variance"] * z.square()
    table["level"], table["depth_pit"] = table["level"] ** 1.5, table["depth_pit"] ** 0.8
    return {name: column.mul(10**digits).round().div(10**digits) for name, column in table.items()}


def ence(table: Arrays, name: str) -> float:
    variance, error = table[f"{name}_variance"], table[f"{name}_squared_error"]
    n, order = len(variance), np.argsort(variance)
    bins = max(1, min(10, n // 100))
    place, gaps = np.floor(bins * (np.arange(n) + 0.5) / n).astype(int), []
    for chosen in (order[place == k] for k in range(bins)):
        rmv, rmse = np.sqrt(variance[chosen].mean()), np.sqrt(error[chosen].mean())
        gaps += [abs(rmv - rmse) / rmv] * len(chosen)
    return float(np.mean(gaps))


def area(levels: np.ndarray) -> float:
    p = (np.arange(200_000) + 0.5) / 200_000
    return float(np.abs(stats.ecdf(levels).cdf.evaluate(p) - p).mean())


def risks(table: Arrays, name: str) -> tuple[float, float]:
    """The area under the risk-coverage curve, and its excess."""
    error = np.sqrt(table[f"{name}_squared_error"])
    orders = np.argsort(table[f"{name}_variance"]), np.argsort(error)
    n = np.arange(1, len(error) + 1)
    found, oracle = ((error[order].cumsum() / n).mean() for order in orders)
    return float(found), float((found - oracle) / (error.mean() - oracle))


REFERENCES: dict[str, Callable[[Arrays], float]] = {
    "miscalibration_area": lambda t: area(t["level"]),
    "overconfidence": lambda t: t["level"].mean() - 0.5,
    "depth_pit_area": lambda t: area(t["depth_pit"]),
    "depth_pit_ks": lambda t: stats.kstest(t["depth_pit"], "uniform").statistic,
    "depth_crps_mm": lambda t: 1000 * t["depth_crps"].mean(),
    "depth_sharpness_mm": lambda t: 1000 * np.sqrt(t["depth_variance"].mean()),
    "projected_sharpness_mrad": lambda t: 1000 * np.sqrt(t["projected_variance"].mean() / 2),
    "depth_ence": lambda t: ence(t, "depth"),
    "projected_ence": lambda t: ence(t, "projected"),
    "depth_risk_coverage_area": lambda t: 1000 * risks(t, "depth")[0],
    "depth_risk_coverage_excess": lambda t: risks(t, "depth")[1],
    "projected_risk_coverage_area": lambda t: 1000 * risks(t, "projected")[0],
    "projected_risk_coverage_excess": lambda t: risks(t, "projected")[1],
}


@pytest.mark.parametrize("n", [2, 57, 399, 1003])
def test_scores_are_those_of_loops_and_libraries(n: int) -> None:
    table = columns(n)
    arrays = {name: column.numpy() for name, column in table.items()}
    found = exact_scores(table)
    assert found.pop("left_out") == 0
    expected = {name: reference(arrays) for name, reference in REFERENCES.items()}
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-5)


@pytest.mark.parametrize("digits", [9, 1])
def test_the_order_of_rows_does_not_matter_and_float32_is_near(digits: int) -> None:
    table, order = columns(300, digits=digits), torch.randperm(300, generator=torch.Generator().manual_seed(0))
    expected = exact_scores(table)
    assert exact_scores({name: column[order] for name, column in table.items()}) == pytest.approx(expected, rel=1e-9)
    single = exact_scores({name: column.float() for name, column in table.items()})
    assert single == pytest.approx(expected, rel=1e-4, abs=1e-5)


def test_weights_count_samples() -> None:
    """A sample of weight 2 is a sample given twice, of weight 0 one left out."""
    table = columns(300, digits=2)
    weight = torch.randint(3, (4, 300), generator=torch.Generator().manual_seed(0)).double()
    together, lines = calibration_scores(ordered(table, weight)), curves(table, weight)
    shares = abscissae(table)["coverage"]
    for row, counts in enumerate(weight):
        repeated = {name: column.repeat_interleave(counts.long()) for name, column in table.items()}
        alone = calibration_scores(ordered(repeated))
        for name, value in alone.items():
            if "ence" not in name:  # its bins depend on the greatest number of samples
                assert together[name][row].item() == pytest.approx(value.item(), rel=1e-9), name
        for name, levels in (("coverage", "level"), ("depth_pit", "depth_pit")):
            torch.testing.assert_close(lines[name][row], coverage(repeated[levels], shares))


def test_ties_count_as_if_in_random_order() -> None:
    table = {name: column.numpy() for name, column in columns(60, digits=0).items()}
    table["depth_variance"] = np.floor(np.log10(table["depth_variance"]))
    random, found = np.random.default_rng(0), []
    for _ in range(4000):
        shuffled = random.permutation(60)
        found.append(1000 * risks({name: column[shuffled] for name, column in table.items()}, "depth")[0])
    area = exact_scores({name: torch.from_numpy(column) for name, column in table.items()})[
        "depth_risk_coverage_area"
    ]
    # argsort is stable enough within shuffled ties; the mean over orders has this standard error
    assert area == pytest.approx(np.mean(found), abs=4 * np.std(found) / 4000**0.5 + 1e-9)
    variance, error = torch.ones(4), torch.tensor([0.0, 0.0, 4.0, 4.0])
    of_ties = in_order_of(variance, {"variance": variance, "error": error})
    assert ence_of(of_ties, "variance", "error", 2).item() == pytest.approx(2**0.5 - 1)
    with pytest.raises(ValueError, match="bins must be at least 1"):
        ence_of(of_ties, "variance", "error", 0)


def test_excess_is_zero_for_an_oracle_and_one_for_a_random_order() -> None:
    table = columns(4000)

    def excess(uncertainty: Tensor) -> float:
        return exact_scores(table | {"depth_variance": uncertainty})["depth_risk_coverage_excess"]

    error = table["depth_squared_error"]
    assert excess(3 * error + 1) == pytest.approx(0)
    assert excess(torch.ones(4000)) == pytest.approx(1)
    assert excess(table["depth_variance"].flip(0)) == pytest.approx(1, abs=0.05)
    assert excess(-error) > 1.5


def test_what_is_not_finite_is_left_out_and_counted_or_refused() -> None:
    table = columns(500)
    broken = {name: column.clone() for name, column in table.items()}
    broken["level"][3], broken["depth_crps"][7], broken["depth_variance"][7] = math.nan, math.inf, math.nan
    rest = torch.ones(500, dtype=torch.bool)
    rest[[3, 7]] = False
    expected = exact_scores({name: column[rest] for name, column in table.items()})
    assert exact_scores(broken) == {**expected, "left_out": 2.0}
    nothing = exact_scores({name: torch.full((4,), math.nan) for name in COLUMNS})
    assert nothing.pop("left_out") == 4
    assert all(math.isnan(score) for score in nothing.values())
    for bad in ([], [0.5, math.nan], [math.inf]):
        with pytest.raises(ValueError, match=rf"samples: got {len(bad)}, .* expected at least one, all finite"):
            coverage(torch.tensor(bad, dtype=torch.float64), torch.ones(1))


N = 10_000


def mean_scale(table: Mapping[str, Tensor]) -> float:
    """The mean of b in millimetres, of Laplace's law of depth: a deviation is sqrt(2) b."""
    return 1000 * float((table["depth_variance"] / 2).sqrt().mean())


def test_calibrated_predictions_have_distances_of_almost_nothing(claimed: Callable) -> None:
    table = claimed(N)
    scores = exact_scores(table)
    assert max(scores[name] for name in ("miscalibration_area", "depth_pit_area")) < 0.01
    assert scores["depth_pit_ks"] < 1.63 / N**0.5  # of 1 %
    assert abs(scores["overconfidence"]) < 0.01
    assert max(scores["depth_ence"], scores["projected_ence"]) < 0.05
    assert scores["depth_crps_mm"] == pytest.approx(0.75 * mean_scale(table), rel=0.02)
    for wrong in ({"overconfidence": 2.0}, {"overconfidence": 0.5}, {"shift": 1.0}, {"shift": -1.0}):
        off = exact_scores(claimed(N, **wrong))
        for name in ("miscalibration_area", "depth_pit_area", "depth_pit_ks", "depth_ence", "projected_ence"):
            assert off[name] > 3 * scores[name] or (name == "projected_ence" and "shift" in wrong), (wrong, name)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_deviations_off_by_a_factor(claimed: Callable, factor: float) -> None:
    """RMSE/RMV is that factor, levels lie on one side, the order of the samples is the same."""
    perfect, scores = exact_scores(claimed(N)), exact_scores(claimed(N, overconfidence=factor))
    assert scores["depth_ence"] == pytest.approx(abs(1 - factor), abs=0.05)
    assert scores["projected_ence"] == pytest.approx(abs(1 - factor), abs=0.05)
    assert scores["miscalibration_area"] == pytest.approx((factor > 1 or -1) * scores["overconfidence"], abs=1e-3)
    # E[F'(z)] = 1/2, but coverage of the interval F' < p is off on both sides: int |F(F'^-1(p)) - p| dp for Laplace
    p = (torch.arange(10_000, dtype=torch.float64) + 0.5) / 20_000  # the lower half
    off = (0.5 * (2 * p) ** (1 / factor) - p).abs().mean().item()
    assert scores["depth_pit_area"] == pytest.approx(off, abs=0.005)
    for name in ("depth_sharpness_mm", "projected_sharpness_mrad"):
        assert scores[name] == pytest.approx(perfect[name] / factor, rel=5e-3)  # Laplace but for 1/a


def test_depth_predicted_one_deviation_too_small(claimed: Callable) -> None:
    table = claimed(N, shift=1.0)
    scores = exact_scores(table)
    assert scores["depth_ence"] == pytest.approx(2**0.5 - 1, abs=0.03)
    # P(X' < X + sqrt(2) b) - 1/2 for independent X and X'
    one_sided = 0.5 - (0.5 + 2**0.5 / 4) * math.exp(-(2**0.5))
    assert overconfidence(table["depth_pit"]).item() == pytest.approx(one_sided, abs=0.01)
    # E|X - X' + sqrt(2) b| - 3/4 b
    expected = 2**0.5 + (1.5 + 2**0.5 / 2) * math.exp(-(2**0.5)) - 0.75
    assert scores["depth_crps_mm"] == pytest.approx(expected * mean_scale(table), rel=0.02)


def test_coverage_is_that_of_uncertainty_toolbox() -> None:
    """Gaussian predictions whose deviation is twice the true one; its curves have 100 points."""
    generator = np.random.default_rng(4)
    deviation, (mean, noise) = generator.uniform(0.5, 2, 3000), generator.normal(size=(2, 3000))
    arguments = mean, 2 * deviation, mean + deviation * noise
    level = torch.from_numpy(2 * stats.norm.cdf(np.abs(noise / 2)) - 1)
    p, share = uct.get_proportion_lists_vectorized(*arguments, num_bins=100, prop_type="interval")
    np.testing.assert_allclose(coverage(level, torch.from_numpy(p)), share, atol=1e-3)
    area = uct.miscalibration_area(*arguments, num_bins=100, vectorized=True, prop_type="interval")
    assert miscalibration_area(level).item() == pytest.approx(area, abs=1e-3)


def test_a_calibration_curve_is_a_sliding_mean() -> None:
    table = columns(500)
    variance, error = table["depth_variance"], table["depth_squared_error"]
    curve = calibration_curve(variance, error, window=100)
    order, kernel = np.argsort(variance.numpy(), kind="stable"), np.ones(100) / 100
    np.testing.assert_allclose(curve.predicted, np.convolve(variance.numpy()[order], kernel, "valid"))
    np.testing.assert_allclose(curve.empirical, np.convolve(error.numpy()[order], kernel, "valid"))
    far = torch.tensor([1e-12] * 10 + [1e12] * 10, dtype=torch.float64)  # small ones keep their digits
    assert calibration_curve(far, far, window=2).predicted[0].item() == pytest.approx(1e-12)
    broken = torch.cat([variance, torch.tensor([torch.inf, 1.0, torch.nan])])
    left = calibration_curve(broken, torch.cat([error, torch.tensor([1.0, torch.nan, 1.0])]), window=100)
    assert (curve.left_out, left.left_out) == (0, 3)
    torch.testing.assert_close(left.empirical, curve.empirical)
    for nothing in (broken[500:501], broken[502:], broken[:0]):
        with pytest.raises(ValueError, match="calibration curve needs"):
            calibration_curve(nothing, nothing, window=200)


@pytest.mark.parametrize(("n", "window", "bins"), [(1, 1, 1), (4, 1, 1), (16, 3, 1), (999, 199, 9), (3000, 200, 10)])
def test_a_small_set_narrows_windows_and_bins(n: int, window: int, bins: int) -> None:
    table = columns(n)
    curve = calibration_curve(table["depth_variance"], table["depth_squared_error"], window=200)
    assert (curve.window, len(curve.predicted), len(curve.empirical)) == (window, n - window + 1, n - window + 1)
    assert ence_bins(ordered(table)["by_level"]) == bins


def numbers(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_energy_score_equals_a_loop_over_pairs_and_keeps_the_digits_of_near_draws() -> None:
    samples, truth = numbers(6, 2, 3, 3), numbers(2, 3, 3, seed=1)
    score = energy_score(samples, truth)
    for i, j in np.ndindex(2, 3):
        drawn = samples[:, i, j].numpy()
        to_truth = np.mean([np.linalg.norm(x - truth[i, j].numpy()) for x in drawn])
        apart = [np.linalg.norm(x - y) for k, x in enumerate(drawn) for m, y in enumerate(drawn) if k != m]
        assert score[i, j].item() == pytest.approx(to_truth - np.mean(apart) / 2)
    near = energy_score(4 + 1e-7 * samples, 4 + 1e-7 * truth)
    torch.testing.assert_close(near, 1e-7 * score, rtol=1e-6, atol=0)
    with pytest.raises(ValueError, match="at least 2 draws"):
        energy_score(samples[:1], truth)


def test_energy_score_is_unbiased_with_few_draws() -> None:
    """Of standard normal positions scored at their centre: E|X| - E|X - X'|/2 = (1 - 1/sqrt 2) sqrt(8/pi)."""
    few = energy_score(numbers(3, 100_000, 3), torch.zeros(100_000, 3).double())
    expected = (1 - 0.5**0.5) * (8 / np.pi) ** 0.5
    assert few.mean().item() == pytest.approx(expected, abs=4 * few.std().item() / 100_000**0.5)


def test_risk_at_a_coverage_equals_a_loop() -> None:
    uncertainty, error = numbers(200).exp(), numbers(200, seed=1).square()
    by_uncertainty, order = in_order_of(uncertainty, {"error": error}), np.argsort(uncertainty.numpy())
    risk = error.numpy()[order].cumsum() / np.arange(1, 201)
    np.testing.assert_allclose(risk_at(by_uncertainty, "error", torch.arange(1, 201).double() / 200), risk)
    # less than one sample is that sample
    assert risk_at(by_uncertainty, "error", torch.tensor([1e-3])).item() == pytest.approx(risk[0])

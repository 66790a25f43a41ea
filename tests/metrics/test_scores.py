"""Scores against plain loops and theory."""

import numpy as np
import pytest
import torch

from phd_exp.metrics.ordered import in_order_of
from phd_exp.metrics.scores import energy_score, risk_at, risk_coverage


def numbers(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def area_and_excess(uncertainty: torch.Tensor, error: torch.Tensor) -> tuple[float, float]:
    columns = {"error": error}
    area, excess = risk_coverage(in_order_of(uncertainty, columns), in_order_of(error, columns), "error")
    return area.item(), excess.item()


def test_energy_score_equals_a_loop_over_pairs() -> None:
    samples, truth = numbers(6, 2, 3, 3), numbers(2, 3, 3, seed=1)
    score = energy_score(samples, truth)
    for i, j in np.ndindex(2, 3):
        drawn = samples[:, i, j].numpy()
        to_truth = np.mean([np.linalg.norm(x - truth[i, j].numpy()) for x in drawn])
        apart = [np.linalg.norm(x - y) for k, x in enumerate(drawn) for m, y in enumerate(drawn) if k != m]
        assert score[i, j].item() == pytest.approx(to_truth - np.mean(apart) / 2)


def test_energy_score_is_unbiased_with_few_draws() -> None:
    """Of standard normal positions scored at their centre: E|X| - E|X - X'|/2 = (1 - 1/sqrt 2) sqrt(8/pi)."""
    expected = (1 - 0.5**0.5) * (8 / np.pi) ** 0.5
    few = energy_score(numbers(3, 100_000, 3), torch.zeros(100_000, 3).double())
    assert few.mean().item() == pytest.approx(expected, abs=4 * few.std().item() / 100_000**0.5)


def test_energy_score_keeps_the_digits_of_near_draws() -> None:
    samples = 4 + 1e-7 * numbers(64, 5, 3)
    truth = torch.full((5, 3), 4.0, dtype=torch.float64)
    expected = 1e-7 * energy_score((samples - 4) * 1e7, torch.zeros(5, 3).double())
    torch.testing.assert_close(energy_score(samples, truth), expected, rtol=1e-6, atol=0)
    with pytest.raises(ValueError, match="at least 2 draws"):
        energy_score(torch.zeros(1, 4, 3), torch.zeros(4, 3))


def test_risk_coverage_equals_a_loop() -> None:
    uncertainty, error = numbers(200).exp(), numbers(200, seed=1).square()
    ordered, best = error.numpy()[np.argsort(uncertainty.numpy())], np.sort(error.numpy())
    risk, least = (np.array([errors[: k + 1].mean() for k in range(200)]) for errors in (ordered, best))
    area, excess = area_and_excess(uncertainty, error)
    assert area == pytest.approx(risk.mean())
    assert excess == pytest.approx((risk.mean() - least.mean()) / (error.mean().item() - least.mean()))
    by_uncertainty = in_order_of(uncertainty, {"error": error})
    coverage = torch.arange(1, 201, dtype=torch.float64) / 200
    np.testing.assert_allclose(risk_at(by_uncertainty, "error", coverage), risk)
    # less than one sample is that sample
    assert risk_at(by_uncertainty, "error", torch.tensor([1e-3])).item() == pytest.approx(risk[0])


def test_ties_count_as_if_in_random_order() -> None:
    uncertainty, error = numbers(60).mul(2).round(), numbers(60, seed=1).square()
    rng = np.random.default_rng(0)
    areas = []
    for _ in range(4000):
        shuffled = rng.permutation(60)
        order = shuffled[np.argsort(uncertainty.numpy()[shuffled], kind="stable")]
        areas.append(np.mean(np.cumsum(error.numpy()[order]) / np.arange(1, 61)))
    standard_error = np.std(areas) / 4000**0.5
    assert area_and_excess(uncertainty, error)[0] == pytest.approx(np.mean(areas), abs=4 * standard_error)


def test_excess_is_zero_for_an_oracle_and_one_for_a_random_order() -> None:
    error = numbers(4000).square()
    assert area_and_excess(3 * error + 1, error)[1] == pytest.approx(0)
    assert area_and_excess(torch.ones(4000), error)[1] == pytest.approx(1)
    assert area_and_excess(numbers(4000, seed=5), error)[1] == pytest.approx(1, abs=0.05)
    assert area_and_excess(-error, error)[1] > 1.5
    assert area_and_excess(error + numbers(4000, seed=6).abs(), error)[1] < 0.5

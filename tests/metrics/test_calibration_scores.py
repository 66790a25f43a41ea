"""Every score on predictions of known calibration: perfect, off by a factor of 2, biased by a deviation.

The expected values are those of a Laplace law of depth with the scale b.
"""

import math
from collections.abc import Callable

import pytest
import torch

from phd_exp.metrics.calibration_scores import COLUMNS, calibration_scores, exact_scores, ordered

N = 10_000
DISTANCES = ("miscalibration_area", "depth_pit_area", "depth_pit_ks", "depth_ence", "projected_ence")


def mean_scale(columns: dict[str, torch.Tensor], overconfidence: float = 1.0) -> float:
    """The mean of b in millimetres: a deviation is sqrt(2) b."""
    return 1000 * overconfidence * float((columns["depth_variance"] / 2).sqrt().mean())


def test_perfect(claimed: Callable) -> None:
    columns = claimed(N)
    scores = exact_scores(columns)
    assert scores["miscalibration_area"] < 0.01
    assert scores["depth_pit_area"] < 0.01
    assert scores["depth_pit_ks"] < 1.63 / N**0.5  # of 1 %
    assert abs(scores["overconfidence"]) < 0.01
    assert scores["depth_ence"] < 0.05
    assert scores["projected_ence"] < 0.05
    assert scores["depth_crps_mm"] == pytest.approx(0.75 * mean_scale(columns), rel=0.02)
    assert scores["left_out"] == 0


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_deviations_off_by_a_factor(claimed: Callable, factor: float) -> None:
    """RMSE/RMV is that factor, levels lie on one side, the order of the samples is the same."""
    perfect, scores = exact_scores(claimed(N)), exact_scores(claimed(N, overconfidence=factor))
    assert scores["depth_ence"] == pytest.approx(abs(1 - factor), abs=0.05)
    assert scores["projected_ence"] == pytest.approx(abs(1 - factor), abs=0.05)
    assert math.copysign(1, scores["overconfidence"]) == math.copysign(1, factor - 1)
    assert scores["miscalibration_area"] == pytest.approx(abs(scores["overconfidence"]), abs=1e-3)
    assert scores["miscalibration_area"] > 0.2
    # E[F'(z)] = 1/2, but coverage of the interval F' < p is off on both sides: int |F(F'^-1(p)) - p| dp for Laplace
    p = (torch.arange(10_000, dtype=torch.float64) + 0.5) / 20_000  # the lower half
    off = (0.5 * (2 * p) ** (1 / factor) - p).abs().mean().item()
    assert scores["depth_pit_area"] == pytest.approx(off, abs=0.005)
    assert scores["depth_crps_mm"] > 1.02 * perfect["depth_crps_mm"]
    for name in ("depth_sharpness_mm", "projected_sharpness_mrad"):
        assert scores[name] == pytest.approx(perfect[name] / factor, rel=5e-3)  # Laplace but for 1/a
    assert scores["projected_risk_coverage_excess"] == pytest.approx(perfect["projected_risk_coverage_excess"])
    assert scores["depth_risk_coverage_excess"] == pytest.approx(perfect["depth_risk_coverage_excess"], abs=1e-3)


def test_depth_predicted_one_deviation_too_small(claimed: Callable) -> None:
    columns = claimed(N, shift=1.0)
    perfect, scores = exact_scores(claimed(N)), exact_scores(columns)
    assert scores["depth_ence"] == pytest.approx(2**0.5 - 1, abs=0.03)
    # P(X' < X + sqrt(2) b) - 1/2 for independent X and X'
    one_sided = 0.5 - (0.5 + 2**0.5 / 4) * math.exp(-(2**0.5))
    assert scores["depth_pit_area"] == pytest.approx(one_sided, abs=0.01)
    assert columns["depth_pit"].mean().item() - 0.5 == pytest.approx(one_sided, abs=0.01)
    # E|X - X' + sqrt(2) b| - 3/4 b
    expected = 2**0.5 + (1.5 + 2**0.5 / 2) * math.exp(-(2**0.5)) - 0.75
    assert scores["depth_crps_mm"] == pytest.approx(expected * mean_scale(columns), rel=0.02)
    assert scores["miscalibration_area"] > 0.1
    assert scores["overconfidence"] > 0.1
    assert scores["projected_ence"] == pytest.approx(perfect["projected_ence"], abs=0.01)


def test_distances_are_least_where_calibrated(claimed: Callable) -> None:
    perfect = exact_scores(claimed(N))
    for wrong in ({"overconfidence": 2.0}, {"overconfidence": 0.5}, {"shift": 1.0}, {"shift": -1.0}):
        scores = exact_scores(claimed(N, **wrong))
        for name in DISTANCES:
            unaffected = name == "projected_ence" and "shift" in wrong
            assert scores[name] > 3 * perfect[name] or unaffected, (wrong, name)


def test_uncertainty_that_varies_finds_bad_predictions(claimed: Callable) -> None:
    columns = dict(claimed(N))
    assert 0.2 < exact_scores(columns)["depth_risk_coverage_excess"] < 0.6
    columns["depth_variance"] = columns["depth_variance"].flip(0)  # of other samples
    assert exact_scores(columns)["depth_risk_coverage_excess"] == pytest.approx(1, abs=0.05)


def test_weights_count_samples(claimed: Callable) -> None:
    """A sample of weight 2 is a sample given twice, of weight 0 one left out."""
    columns = claimed(300)
    weight = torch.randint(3, (4, 300), generator=torch.Generator().manual_seed(0)).double()
    together = calibration_scores(ordered(columns, weight))
    for row, counts in enumerate(weight):
        repeated = {name: columns[name].repeat_interleave(counts.long()) for name in COLUMNS}
        alone = calibration_scores(ordered(repeated))
        for name, value in alone.items():
            if "ence" not in name:  # its bins depend on the greatest number of samples
                assert together[name][row].item() == pytest.approx(value.item(), rel=1e-9), name


def test_what_is_not_finite_is_left_out_and_counted(claimed: Callable) -> None:
    columns = claimed(500)
    broken = {name: columns[name].clone() for name in COLUMNS}
    broken["level"][3], broken["depth_crps"][7], broken["depth_variance"][7] = math.nan, math.inf, math.nan
    rest = torch.ones(500, dtype=torch.bool)
    rest[[3, 7]] = False
    expected = exact_scores({name: columns[name][rest] for name in COLUMNS})
    assert exact_scores(broken) == {**expected, "left_out": 2.0}
    nothing = exact_scores({name: torch.full((4,), math.nan) for name in COLUMNS})
    assert nothing.pop("left_out") == 4
    assert all(math.isnan(score) for score in nothing.values())

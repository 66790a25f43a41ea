"""The reference interval contains the distances of calibrated predictions as often as it claims."""

import numpy as np
import pytest
import torch
from scipy import stats

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.columns import distribution_columns, draws, nees_columns
from phd_exp.evaluation.reference import REFERENCED, calibrated_reference, groups_of
from phd_exp.metrics.calibration import miscalibration_area, uniform_distance
from phd_exp.metrics.calibration_scores import exact_scores
from phd_exp.metrics.groups import worst_group
from phd_exp.metrics.ordered import Ordered
from tests.support.synthetic import calibrated, truths

TIMES = 100


def scores_of(prediction: ProjectedHuber, xyz: torch.Tensor) -> dict[str, float]:
    columns = distribution_columns(prediction, xyz)
    found = exact_scores(columns)
    found["inside_90"] = 100 * float((columns["level"] <= 0.9).double().mean())
    found["group_miscalibration"] = float(worst_group(columns["level"], groups_of(prediction), torch.ones(len(xyz))))
    return found | {name: float(column.mean()) for name, column in nees_columns(prediction, xyz).items()}


@pytest.mark.slow
def test_calibrated_models_lie_in_the_interval_95_times_of_100() -> None:
    n = 60
    prediction = calibrated(truths(n, seed=1)[0], a=20.0, A=600.0, overconfidence=1.0, seed=3)
    reference = calibrated_reference(prediction)
    inside, below = dict.fromkeys(REFERENCED, 0), dict.fromkeys(REFERENCED, 0)
    for xyz in draws(prediction, TIMES, seed=5):
        scores = scores_of(prediction, xyz)
        for name, band in reference.items():
            inside[name] += band.low <= scores[name] <= band.high
            below[name] += scores[name] < band.value
    slack = 4 * np.sqrt(np.array([0.95 * 0.05, 0.25]) / TIMES)
    assert reference.keys() == set(REFERENCED)
    for name in REFERENCED:
        assert inside[name] / TIMES == pytest.approx(0.95, abs=slack[0]), name
        assert below[name] / TIMES == pytest.approx(0.5, abs=slack[1]), name


@pytest.mark.parametrize("n", [1, 60, 2000])
def test_the_band_of_coverage_has_its_nominal_probability(n: int) -> None:
    """Neither tail has more than 2.5 %, and each would with the next number."""
    prediction = calibrated(truths(n, seed=1)[0], a=20.0, A=600.0, overconfidence=1.0, seed=3)
    band = calibrated_reference(prediction, simulations=1)["inside_90"]
    law, low, high = stats.binom(n, 0.9), round(n * band.low / 100), round(n * band.high / 100)
    assert law.cdf(low - 1) <= 0.025 < law.cdf(low)
    assert law.sf(high) <= 0.025 < law.sf(high - 1)
    assert law.cdf(high) - law.cdf(low - 1) >= 0.95


def test_bands_of_distances_have_their_nominal_probability() -> None:
    n, times = 500, 4000
    prediction = calibrated(truths(n, seed=1)[0], a=20.0, A=600.0, overconfidence=1.0, seed=3)
    reference = calibrated_reference(prediction)
    levels = torch.rand(times, n, generator=torch.Generator().manual_seed(7), dtype=torch.float64).sort().values
    ordered = Ordered(levels, torch.ones_like(levels), {})
    for name, values in {
        "miscalibration_area": miscalibration_area(ordered),
        "depth_pit_ks": uniform_distance(ordered),
    }.items():
        inside = (values >= reference[name].low) & (values <= reference[name].high)
        assert float(inside.double().mean()) == pytest.approx(0.95, abs=0.0125), name
    assert float(miscalibration_area(levels[3])) == pytest.approx(float(miscalibration_area(ordered)[3]))


def test_overconfident_models_lie_above_it() -> None:
    prediction = calibrated(truths(250, seed=1)[0], a=20.0, A=600.0, overconfidence=2.0, seed=3)
    scores = scores_of(prediction, truths(250, seed=1)[0])
    reference = calibrated_reference(prediction)
    assert all(scores[name] > reference[name].high for name in REFERENCED if name != "inside_90")
    assert scores["inside_90"] < reference["inside_90"].low


def test_regions_wrong_in_opposite_ways_are_found_though_all_together_are_right() -> None:
    """Levels of the one half are those of three times too precise, of the other half the rest of uniform ones."""
    n = 1000
    prediction = calibrated(truths(n, seed=1)[0], a=20.0, A=600.0, overconfidence=1.0, seed=3)
    groups, one = groups_of(prediction), torch.ones(n)
    reference = calibrated_reference(prediction)["group_miscalibration"]
    level = torch.linspace(0.5 / n, 1 - 0.5 / n, n)
    shuffled = level[torch.randperm(n, generator=torch.Generator().manual_seed(0))]
    assert reference.low <= worst_group(shuffled, groups, one) <= reference.high
    # half of the samples, those to the left, get the levels above 0.5 three times as often
    odds = torch.where(prediction.mu_xy[:, 0] < 0, 0.5, -0.5) + torch.randn(
        n, generator=torch.Generator().manual_seed(1)
    )
    opposite = torch.empty(n).scatter(0, odds.argsort(), level)
    assert torch.equal(opposite.sort().values, level)
    assert worst_group(opposite, groups, one) > 2 * reference.high
    # blind groups of a tenth do not find it: each is a sample of all levels
    blind = torch.stack([torch.randperm(n, generator=torch.Generator().manual_seed(k)) for k in range(30)])
    blind = (blind[:, None] < torch.linspace(0.1, 1, 10)[:, None] * n).float()
    assert worst_group(opposite, blind, one) < reference.high


def test_one_sample_and_the_seed() -> None:
    prediction = calibrated(truths(1, seed=1)[0], a=20.0, A=600.0, overconfidence=1.0, seed=3)
    first, again = (calibrated_reference(prediction, simulations=50) for _ in range(2))
    assert first == again
    assert first.pop("inside_90").high == 100
    assert all(0 < band.low <= band.value <= band.high for band in first.values())
    assert torch.isfinite(torch.tensor([band.high for band in first.values()])).all()

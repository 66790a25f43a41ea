"""The reference interval contains the distances of calibrated predictions as often as it claims."""

import numpy as np
import pytest
import torch

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.columns import distribution_columns, draws
from phd_exp.evaluation.reference import DISTANCES, calibrated_reference
from phd_exp.metrics.calibration_scores import exact_scores
from tests.support.synthetic import calibrated, truths

TIMES = 100


def test_calibrated_models_lie_in_the_interval_95_times_of_100() -> None:
    n = 60
    prediction = calibrated(truths(n, seed=1)[0], a=20.0, A=600.0, overconfidence=1.0, seed=3)
    reference = calibrated_reference(prediction, simulations=200)
    inside, below = dict.fromkeys(DISTANCES, 0), dict.fromkeys(DISTANCES, 0)
    drawn = draws(prediction, TIMES, seed=5).flatten(0, 1)
    often = (prediction.mu_xy.repeat(TIMES, 1), prediction.mu_z.repeat(TIMES))
    often += (prediction.A.repeat(TIMES, 1, 1), prediction.a.repeat(TIMES))
    columns = distribution_columns(ProjectedHuber(*often), drawn)
    for time in range(TIMES):
        scores = exact_scores({name: column[time * n : (time + 1) * n] for name, column in columns.items()})
        for name, band in reference.items():
            inside[name] += band.low <= scores[name] <= band.high
            below[name] += scores[name] < band.value
    slack = 4 * np.sqrt(np.array([0.95 * 0.05, 0.25]) / TIMES)
    for name in DISTANCES:
        assert inside[name] / TIMES == pytest.approx(0.95, abs=slack[0]), name
        assert below[name] / TIMES == pytest.approx(0.5, abs=slack[1]), name


def test_overconfident_models_lie_above_it() -> None:
    prediction = calibrated(truths(250, seed=1)[0], a=20.0, A=600.0, overconfidence=2.0, seed=3)
    scores = exact_scores(distribution_columns(prediction, truths(250, seed=1)[0]))
    reference = calibrated_reference(prediction)
    assert all(scores[name] > reference[name].high for name in DISTANCES)


def test_one_sample_and_the_seed() -> None:
    prediction = calibrated(truths(1, seed=1)[0], a=20.0, A=600.0, overconfidence=1.0, seed=3)
    first, again = (calibrated_reference(prediction, simulations=50) for _ in range(2))
    assert first == again
    assert all(0 < band.low <= band.value <= band.high for band in first.values())
    assert torch.isfinite(torch.tensor([band.high for band in first.values()])).all()

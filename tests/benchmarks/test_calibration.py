"""What measuring calibration costs: processor time of one core, the shapes of annotations checked as in all tests."""

import time
from collections.abc import Callable

import pytest
import torch

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.columns import Columns, distribution_columns, draws
from phd_exp.evaluation.predictions import evaluate
from phd_exp.metrics.bootstrap import bands
from phd_exp.metrics.calibration_scores import calibration_scores, ordered
from phd_exp.metrics.rows import Rows

pytestmark = pytest.mark.bench
N, BATCH = 2000, 64


@pytest.fixture(scope="module")
def columns() -> Columns:
    generator = torch.Generator().manual_seed(1)
    raw = torch.randn(N, 7, generator=generator, dtype=torch.float64)
    f = 1200 + 800 * torch.rand(N, generator=generator, dtype=torch.float64)
    prediction = ProjectedHuber.from_raw(raw, f=f, S=224.0, mu_z0=2.5e-3)
    xyz = draws(prediction, 1, seed=2)[0]
    errors = {name: f / 1000 for name in ("projected_error_mm", "depth_error_mm", "energy_score")}
    known = {"f": f, "z": xyz[:, 2], "visibility": torch.rand(N, generator=generator)}
    return distribution_columns(prediction, xyz) | errors | known


def seconds(work: Callable[[], object]) -> float:
    work()  # what is done once
    start = time.process_time()
    work()
    return time.process_time() - start


def test_an_update_of_the_metric_takes_a_millisecond(columns: Columns) -> None:
    parts = [{name: column[i : i + BATCH] for name, column in columns.items()} for i in range(0, N, BATCH)]
    metric = Rows()
    took = seconds(lambda: [metric.update(part) for part in parts]) / len(parts)
    print(f"update with {BATCH} samples: {1e3 * took:.2f} ms")
    assert took < 1e-3


def test_bands_of_all_scores_take_a_second(columns: Columns) -> None:
    took = seconds(lambda: bands(lambda c, weight: calibration_scores(ordered(c, weight)), columns, 200, 0))
    print(f"200 resamples of {N} samples, every score: {took:.2f} s")
    assert took < 1


def test_an_evaluation_takes_three_seconds(columns: Columns) -> None:
    took = seconds(lambda: evaluate({name: column.numpy() for name, column in columns.items()}))
    print(f"evaluation of {N} samples with bands and strata: {took:.2f} s")
    assert took < 3

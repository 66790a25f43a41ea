"""What measuring calibration costs: processor time of one core, the shapes of annotations checked as in all tests."""

import time
from collections.abc import Callable

import pytest
import torch

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.columns import Columns, coordinates, distribution_columns, draws
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
    known = coordinates("", xyz) | {"f": f, "visibility": torch.rand(N, generator=generator)}
    return distribution_columns(prediction, xyz) | errors | known


def update(columns: Columns) -> None:
    metric = Rows()
    for i in range(0, N, BATCH):
        metric.update({name: column[i : i + BATCH] for name, column in columns.items()})


@pytest.mark.parametrize(
    ("what", "work", "most"),
    [
        (f"{N // BATCH + 1} updates with {BATCH} samples", update, 1e-3 * (N // BATCH + 1)),
        (
            f"200 resamples of {N} samples, every score",
            lambda columns: bands(lambda c, weight: calibration_scores(ordered(c, weight)), columns, 200, 0),
            1.0,
        ),
        (
            f"evaluation of {N} samples with bands and strata",
            lambda columns: evaluate({name: column.numpy() for name, column in columns.items()}),
            3.0,
        ),
    ],
)
def test_calibration_costs_little(
    columns: Columns, what: str, work: Callable[[Columns], object], most: float, record: Callable[..., None]
) -> None:
    work(columns)  # what is done once
    start = time.process_time()
    work(columns)
    took = time.process_time() - start
    record(what, f"{took:.3f} s", "", f"{took:.3f} s", f"{most:.3f} s")
    assert took < most

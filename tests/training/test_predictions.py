"""A prediction as columns: what the record holds is what the formulas say."""

import math
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest
import torch

from phd_exp.config import check
from phd_exp.data.batches import Batch
from phd_exp.distributions import PointEstimate, ProjectedHuber
from phd_exp.distributions.columns import from_columns
from phd_exp.evaluation.predictions import evaluate
from phd_exp.geometry import DepthScale, Projected
from phd_exp.metrics.rows import Rows
from phd_exp.training.build import build_data, build_module
from phd_exp.training.predictions import calibration_curves, columns, summary, write_parquet
from tests.support.heads import SHAPED

N = 60
DEPTH = DepthScale.from_ranges(f_range=(1200.0, 2000.0), z_range=(3.0, 5.0))


@pytest.fixture
def batch() -> Batch:
    generator = torch.Generator().manual_seed(0)
    n = 12
    z = 3 + 2 * torch.rand(n, generator=generator)
    xyz = torch.stack([0.05 * z, -0.02 * z, z], dim=-1)
    return Batch(
        image=torch.zeros(n, 2, 2, 3, dtype=torch.uint8),
        xyz=xyz,
        f=torch.linspace(1200, 2000, n),
        S=224.0,
        row=torch.arange(n).flip(0),
    )


@pytest.fixture
def distribution(batch: Batch) -> ProjectedHuber:
    raw = torch.randn(len(batch), 7, generator=torch.Generator().manual_seed(1))
    return ProjectedHuber.from_raw(raw, f=batch.f, S=batch.S, mu_z0=DEPTH.mu_z0)


def test_columns_rebuild_the_distribution(batch: Batch, distribution: ProjectedHuber) -> None:
    table = columns(distribution, batch)
    A = torch.stack(
        [torch.stack([table["A_xx"], table["A_xy"]], -1), torch.stack([table["A_xy"], table["A_yy"]], -1)], -2
    )
    mu_xy = torch.stack([table["mu_x"], table["mu_y"]], -1)
    rebuilt = ProjectedHuber(mu_xy, table["mu_z"], A, table["a"])
    torch.testing.assert_close(-rebuilt.log_prob(batch.xyz.double()), table["nll"], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(rebuilt.depth_variance, table["depth_variance"], rtol=1e-4, atol=0)
    torch.testing.assert_close(rebuilt.depth_median, table["median_z"], rtol=1e-4, atol=0)


def test_an_evaluated_precision_that_is_nearly_singular_is_positive_definite_in_the_record(
    composed: Callable, batch: Batch
) -> None:
    """Raw numbers of eigenvalues of B in the ratio of 1e10: rounded to float32, such a matrix would be indefinite."""
    config = check(composed("preset=smoke"))
    module = build_module(config, build_data(config)).eval()
    bias = module.regressor.last.bias
    turn = torch.tensor([[0.8, -0.6], [0.6, 0.8]])
    M = turn @ torch.diag(torch.tensor([2000.0, math.log(2e-7)])) @ turn.mT
    bias.data[2:5] = torch.stack([M[0, 0], math.sqrt(2) * M[0, 1], M[1, 1]])
    with torch.no_grad():
        table = columns(module(batch), batch)
    assert (torch.linalg.eigvalsh(from_columns(table).A) > 0).all()


def test_summary_is_the_mean_of_the_columns(batch: Batch, distribution: ProjectedHuber) -> None:
    table = columns(distribution, batch)
    means = summary(table)
    assert means["test/nll"] == pytest.approx(-distribution.log_prob(batch.xyz).mean().item(), rel=1e-5)
    assert means["test/depth_precision"] == pytest.approx(distribution.a.mean().item(), rel=1e-5)
    determinant = distribution.log_det_A.exp().mean().item()
    assert means["test/projected_precision"] == pytest.approx(determinant, rel=1e-4)
    scale = 1000 * distribution.depth_crps(batch.xyz[:, 2]).mean().item()
    assert means["test/calibration/depth_crps_mm"] == pytest.approx(scale, rel=1e-5)
    assert means["test/calibration/left_out"] == 0


def test_an_energy_score_disturbs_no_other_random_numbers(batch: Batch, distribution: ProjectedHuber) -> None:
    """The same every time, whatever was drawn before."""
    torch.manual_seed(0)
    expected = torch.rand(3)
    torch.manual_seed(0)
    once = columns(distribution, batch)["energy_score"]
    assert torch.equal(torch.rand(3), expected)
    assert torch.equal(columns(distribution, batch)["energy_score"], once)
    assert (once > 0).all()


def test_a_point_estimate_has_errors_alone(batch: Batch) -> None:
    chart = Projected(DEPTH)
    estimate = PointEstimate(chart.coordinates(batch.xyz, batch.camera), chart, batch.camera)
    table = columns(estimate, batch)
    assert "nll" not in table
    errors = ("projected_error_mm", "depth_error_mm", "ale_m", "relative_error")
    assert summary(table).keys() == {f"test/{name}" for name in errors}
    assert table["projected_error_mm"].max() < 0.01


def test_the_error_of_the_distance_is_measured_from_the_camera(batch: Batch) -> None:
    """Estimates on a sphere around the camera have none; estimates on the true ray have that of their distance."""
    chart, distance = Projected(DEPTH), batch.xyz.norm(dim=-1).double()
    turned = batch.xyz[:, [1, 0, 2]]
    for estimate, expected in ((turned, 0.0), (1.1 * batch.xyz, 10.0)):
        table = columns(PointEstimate(chart.coordinates(estimate, batch.camera), chart, batch.camera), batch)
        torch.testing.assert_close(table["ale_m"], expected / 100 * distance, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(table["relative_error"], 100 * table["ale_m"] / distance, rtol=1e-4, atol=1e-5)


def test_the_record_is_in_the_order_of_the_data_set(
    batch: Batch, distribution: ProjectedHuber, tmp_path: Path
) -> None:
    known = {"file_name": [f"{i:06d}.png" for i in range(len(batch))], "f": [1500.0 + i for i in range(len(batch))]}
    rows = Rows()
    rows.update(columns(distribution, batch))
    write_parquet(tmp_path / "predictions.parquet", rows.columns(), known)
    frame = pd.read_parquet(tmp_path / "predictions.parquet")
    assert frame["file_name"].tolist() == [f"{i:06d}.png" for i in range(len(batch))]
    assert frame["f"].tolist() == known["f"]
    assert frame["z"].tolist() == batch.xyz[:, 2].flip(0).double().tolist()
    assert "row" not in frame


@pytest.mark.parametrize("model", SHAPED)
def test_a_density_is_recorded_and_evaluated_without_parameters(model: str) -> None:
    """As by an untrained network, on positions throughout the range."""
    generator = torch.Generator().manual_seed(0)
    z = 3 + 2 * torch.rand(N, generator=generator)
    xyz = torch.stack([0.05 * z, -0.02 * z, z], dim=-1)
    batch = Batch(torch.zeros(N, 2, 2, 3, dtype=torch.uint8), xyz, torch.full((N,), 1550.0), 224.0, torch.arange(N))
    raw = torch.randn(N, SHAPED[model].n_outputs, generator=generator)
    prediction = SHAPED[model](raw, batch.camera)
    table = columns(prediction, batch)
    assert "a" not in table
    assert all(column.isfinite().all() for column in table.values())
    assert summary(table)["test/nll"] == pytest.approx(float(-prediction.log_prob(xyz).mean()), rel=1e-5)
    assert calibration_curves(table, 20).keys() == {"depth", "projected"}
    evaluation = evaluate({name: column.numpy() for name, column in table.items()}, resamples=20)
    assert evaluation.left_out == 0
    assert evaluation.reference == {}
    assert {"nll", "inside_90", "depth_crps_mm", "energy_score_mm"} < evaluation.scores.keys()
    assert "coverage" in evaluation.curves

"""Densities other than the paper's in the record, the report's evaluation, and answers."""

import pytest
import torch

from phd_exp.data.batches import Batch
from phd_exp.evaluation.predictions import evaluate
from phd_exp.training.predictions import calibration_curves, columns, summary
from tests.support.heads import SHAPED

N = 60


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

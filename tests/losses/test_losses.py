"""Losses against a plain computation of what they are named after."""

import pytest
import torch

from phd_exp.distributions import PointEstimate, ProjectedHuber
from phd_exp.geometry import Camera, Cartesian, Chart, DepthScale, LogDepth, Projected
from phd_exp.losses import MeanAbsoluteError, NegativeLogLikelihood

DEPTH = DepthScale.from_ranges(f_range=(1200.0, 2000.0), z_range=(3.0, 5.0))
CHARTS = [Projected(DEPTH), LogDepth(DEPTH), Cartesian(DEPTH)]


@pytest.fixture
def camera() -> Camera:
    return Camera(torch.tensor([1200.0, 1500.0, 2000.0]), 224.0)


@pytest.fixture
def xyz() -> torch.Tensor:
    return torch.tensor([[0.1, -0.2, 3.1], [-0.2, 0.1, 4.9], [0.05, 0.2, 3.7]])


def test_nll_is_one_number_a_sample(camera: Camera, xyz: torch.Tensor) -> None:
    raw = torch.linspace(-1, 1, 21).view(3, 7)
    prediction = ProjectedHuber.from_raw(raw, f=camera.f, S=camera.S, mu_z0=DEPTH.mu_z0)
    loss = NegativeLogLikelihood()(prediction, xyz)
    single = [
        -ProjectedHuber.from_raw(raw[i], f=camera.f[i], S=camera.S, mu_z0=DEPTH.mu_z0).log_prob(xyz[i])
        for i in range(3)
    ]
    torch.testing.assert_close(loss, torch.stack(single))


@pytest.mark.parametrize("chart", CHARTS, ids=lambda chart: type(chart).__name__)
def test_mae_is_zero_at_the_truth_and_a_distance_elsewhere(chart: Chart, camera: Camera, xyz: torch.Tensor) -> None:
    truth = chart.coordinates(xyz, camera)
    assert MeanAbsoluteError()(PointEstimate(truth, chart, camera), xyz).tolist() == [0, 0, 0]
    offset = torch.tensor([[3.0, 4.0, 0.0], [0.0, 0.0, 2.0], [0.0, 0.0, 0.0]])
    loss = MeanAbsoluteError()(PointEstimate(truth + offset, chart, camera), xyz)
    assert loss.tolist() == pytest.approx([5, 2, 0], rel=1e-6)

"""Temperatures: known ones are found again, and the fit is the minimum that it claims to be."""

import math
from dataclasses import replace

import pytest
import torch

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.columns import draws
from phd_exp.distributions.temperature import Slope, Temperature
from tests.support.densities import parameters


@pytest.fixture(scope="module")
def truth() -> ProjectedHuber:
    generator = torch.Generator().manual_seed(1)
    raw = torch.randn(10_000, 7, generator=generator, dtype=torch.float64)
    raw[:, 2:6] = 4 + 2 * raw[:, 2:6].abs()
    return ProjectedHuber.from_raw(raw, f=1500.0, S=224.0, mu_z0=2.5e-3)


@pytest.fixture(scope="module")
def xyz(truth: ProjectedHuber) -> torch.Tensor:
    return draws(truth, 1, seed=2)[0]


@pytest.mark.parametrize(("projected", "depth"), [(2.0, 3.0), (1.0, 1.0), (0.25, 0.1), (1.0, 50.0)])
def test_finds_by_how_much_predictions_are_overconfident(
    truth: ProjectedHuber, xyz: torch.Tensor, projected: float, depth: float
) -> None:
    predicted = Temperature(1 / projected, 1 / depth).apply(truth)
    found = Temperature.fit(predicted, xyz)
    assert found.projected == pytest.approx(projected, rel=0.02)
    assert found.depth == pytest.approx(depth, rel=0.03)
    # what it mends is the truth again, not merely something of the same spread
    mended = found.apply(predicted)
    torch.testing.assert_close(mended.depth_variance, truth.depth_variance, rtol=0.07, atol=0)
    torch.testing.assert_close(mended.projected_covariance, truth.projected_covariance, rtol=0.05, atol=1e-9)


def test_finds_a_slope(truth: ProjectedHuber, xyz: torch.Tensor) -> None:
    """Of predictions whose spreads vary too little in projection, and too much in depth."""
    wrong = Temperature(0.5, 0.3, Slope(0.4, -20.0, 20.0), Slope(-0.2, -20.0, 20.0)).apply(truth)
    mended = Temperature.fit(wrong, xyz).apply(wrong)
    for found, right in ((mended.a.log(), truth.a.log()), (mended.log_det_A, truth.log_det_A)):
        middle = (right - right.median()).abs() < right.std()  # far beyond, temperatures are constant
        torch.testing.assert_close(found[middle], right[middle], rtol=0, atol=0.1)


def test_few_predictions_have_little_slope(truth: ProjectedHuber, xyz: torch.Tensor) -> None:
    few = Temperature.fit(truth[torch.arange(10_000) < 8], xyz[:8])
    assert few.projected_slope is not None
    assert abs(few.projected_slope.slope) < 0.5


def test_is_the_minimum_of_the_mean_nll(truth: ProjectedHuber, xyz: torch.Tensor) -> None:
    predicted = truth.tempered(0.5, 0.3)
    found = Temperature.fit(predicted, xyz)

    def nll(temperature: Temperature) -> float:
        return -float(temperature.apply(predicted).log_prob(xyz).mean())

    least = nll(found)
    for factor in (0.99, 0.999, 1.001, 1.01):
        assert nll(replace(found, projected=found.projected * factor)) > least
        assert nll(replace(found, depth=found.depth * factor)) > least
    for name in ("projected_slope", "depth_slope"):
        slope = getattr(found, name)
        for step in (-0.02, 0.02):
            assert nll(replace(found, **{name: replace(slope, slope=slope.slope + step)})) > least


def test_leaves_mode_and_batch(distribution: ProjectedHuber) -> None:
    hotter = Temperature(2.0, 3.0).apply(distribution.expand((2, 3)))
    assert hotter.batch_shape == (2, 3)
    torch.testing.assert_close(hotter.mode[0, 0], distribution.mode)
    torch.testing.assert_close(hotter.mu_xy[0, 0], distribution.mu_xy)
    torch.testing.assert_close(hotter.m_xy[0, 0], distribution.m_xy)
    torch.testing.assert_close(hotter.apex[0, 0], distribution.apex)
    torch.testing.assert_close(hotter.whiten(distribution.mean)[0, 0], distribution.whiten(distribution.mean) / 2)
    torch.testing.assert_close(hotter.A[0, 0], distribution.A / 2)
    torch.testing.assert_close(hotter.a[0, 0], distribution.a / 3)
    torch.testing.assert_close(hotter.log_det_A[0, 0], distribution.log_det_A - 2 * math.log(2))
    rebuilt = ProjectedHuber(**parameters(hotter), rounding=hotter.rounding)
    torch.testing.assert_close(hotter.log_prob(distribution.mean), rebuilt.log_prob(distribution.mean))


def test_extremes_stay_finite() -> None:
    raw = torch.tensor([[1e4, -1e4, -1e4, 1e4, -1e4, -1e4, 0.0], [0, 0, 1e4, 0, 1e4, 1e4, 1e4]])
    prediction = ProjectedHuber.from_raw(raw, f=1500.0, S=224.0, mu_z0=2.5e-3, validate_args=False)
    hotter = Temperature(3.0, 0.1).apply(prediction)
    assert hotter.log_prob(torch.tensor([0.1, 0.2, 4.0])).isfinite().all()


@pytest.mark.parametrize(
    "positions",
    [torch.zeros(0, 3), torch.tensor([[0.0, torch.nan, 4.0]]), torch.tensor([[0.0, 0.0, -4.0]])],
    ids=["none", "NaN", "behind the camera"],
)
def test_refuses_what_cannot_be_fitted(positions: torch.Tensor) -> None:
    one = ProjectedHuber(torch.zeros(2), torch.tensor(4.0), torch.eye(2), torch.tensor(1.0))
    with pytest.raises(ValueError, match="fitted to finite predictions"):
        Temperature.fit(one.expand((len(positions),)), positions)


def test_refuses_errors_of_zero(truth: ProjectedHuber) -> None:
    with pytest.raises(ValueError, match="no temperature fits"):
        Temperature.fit(truth.tempered(1e-30, 1e-30), 1e3 * truth.mean)

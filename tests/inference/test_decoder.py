"""The decoder without torch says what the torch class says, for any numbers a network may return."""

import numpy as np
import pytest
import torch

from phd_exp.distributions import PointEstimate, ProjectedHuber
from phd_exp.geometry import Camera, Cartesian, Chart, DepthScale, LogDepth, Projected
from phd_exp.inference.decoder import Decoder

SIDE = 112
DEPTH = DepthScale.from_ranges(f_range=(600.0, 1000.0), z_range=(3.0, 5.0))
P = (0.005, 0.05, 0.25, 0.5, 0.75, 0.95, 0.995)
SCALES = (0.0, 1e-3, 1.0, 10.0, 60.0)
TOLERANCE = 1e-5


def decoder(head: str = "ProjectedHuber", **changes: object) -> Decoder:
    values = {"side": SIDE, "head": head, "mu_z0": DEPTH.mu_z0, "D": DEPTH.D, "z_centre": DEPTH.z_centre}
    return Decoder(**(values | {"xy_unit": 0.25, "constant_f": None} | changes))  # type: ignore[arg-type]


def raws(scale: float) -> torch.Tensor:
    return scale * torch.randn(200, 7, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def focal_lengths(n: int) -> torch.Tensor:
    return torch.linspace(600, 1000, n, dtype=torch.float64)


def worst(here: np.ndarray, there: torch.Tensor) -> float:
    """The largest deviation of a batch, each element relative to the largest number it consists of."""
    expected = there.numpy().reshape(len(there), -1)
    size = np.abs(expected).max(axis=1, keepdims=True)
    return float((np.abs(here.reshape(expected.shape) - expected) / np.maximum(size, 1e-300)).max())


@pytest.mark.parametrize("scale", SCALES)
def test_everything_is_that_of_the_torch_class(scale: float) -> None:
    raw = raws(scale)
    f = focal_lengths(len(raw))
    there = ProjectedHuber.from_raw(raw, f=f, S=float(SIDE), mu_z0=DEPTH.mu_z0)
    here = decoder()(raw.numpy(), f.numpy())
    assert not isinstance(here, np.ndarray)
    assert worst(here.mode, there.mode) < TOLERANCE
    assert worst(here.mean, there.mean) < TOLERANCE
    assert worst(here.covariance, there.covariance_matrix) < TOLERANCE
    assert worst(here.median_depth, there.depth_median) < TOLERANCE
    quantiles = torch.stack([there.depth_icdf(p) for p in P], dim=-1)
    for place in range(len(P)):
        assert worst(here.depth_quantile(P)[:, place], quantiles[:, place]) < TOLERANCE
    torch.manual_seed(0)
    for xyz in (there.sample(), there.mode, 1.5 * there.mode, there.mode + torch.tensor([0.3, 0.1, 0.2])):
        # q is a difference: where its parts are huge, rounding leaves no digits of it, here and there alike
        parts = np.abs(here.nu_xy).max(-1) * xyz[:, 2].numpy()
        sound = (parts < 1e6) & (torch.linalg.cond(there.A).numpy() < 1e6)
        assert sound.sum() >= 10
        for ours, theirs in ((here.log_prob, there.log_prob), (here.level, there.level)):
            expected = theirs(xyz).numpy()[sound]
            np.testing.assert_allclose(ours(xyz.numpy())[sound], expected, rtol=TOLERANCE, atol=TOLERANCE)


@pytest.mark.parametrize("w_1", [-300.0, -30.0, -3.0, 18.9, 19.1, 1e3, 1e6])
def test_depth_at_any_precision(w_1: float) -> None:
    raw = torch.zeros(3, 7, dtype=torch.float64)
    raw[:, 5], raw[:, 6] = w_1, torch.tensor([-2.0, 0.0, 2.0])
    there = ProjectedHuber.from_raw(raw, f=800.0, S=float(SIDE), mu_z0=DEPTH.mu_z0, validate_args=False)
    here = decoder()(raw.numpy(), 800.0)
    assert not isinstance(here, np.ndarray)
    for p in P:
        expected = there.depth_icdf(p).log().numpy()
        np.testing.assert_allclose(np.log(here.depth_quantile(p)), expected, rtol=TOLERANCE, atol=TOLERANCE)
    if w_1 > -100:  # beyond, variances overflow
        assert worst(here.covariance, there.covariance_matrix) < TOLERANCE


def test_behind_the_camera_there_is_nothing() -> None:
    here = decoder()(np.zeros(7), 800.0)
    assert not isinstance(here, np.ndarray)
    assert here.log_prob([0.0, 0.0, -1.0]) == -np.inf
    assert here.level([0.0, 0.0, -1.0]) == 1


def test_temperatures_divide_the_precisions() -> None:
    raw = raws(3.0)
    there = ProjectedHuber.from_raw(raw, f=800.0, S=float(SIDE), mu_z0=DEPTH.mu_z0).tempered(1.3, 0.7)
    here = decoder(temperature=(1.3, 0.7))(raw.numpy(), 800.0)
    assert not isinstance(here, np.ndarray)
    assert worst(here.mode, there.mode) < TOLERANCE
    assert worst(here.covariance, there.covariance_matrix) < TOLERANCE


@pytest.mark.parametrize("chart", [Projected(DEPTH), LogDepth(DEPTH), Cartesian(DEPTH)], ids=repr)
@pytest.mark.parametrize("constant_f", [None, 777.0])
def test_baselines_are_points(chart: Chart, constant_f: float | None) -> None:
    raw = raws(1.0)[:, :3]
    f = focal_lengths(len(raw))
    told = f if constant_f is None else torch.full_like(f, constant_f)
    there = PointEstimate(raw, chart, Camera(told, float(SIDE))).mode
    here = decoder(type(chart).__name__, constant_f=constant_f)(raw.numpy(), f.numpy())
    assert isinstance(here, np.ndarray)
    assert worst(here, there) < 1e-12


def test_a_focal_length_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="f must be positive"):
        decoder()(np.zeros(7), 0.0)

"""Mean and covariance of paths: closed forms, and simulated paths with and without slow errors."""

import numpy as np
import pytest
import torch
from scipy import stats

from phd_exp.distributions import ProjectedHuber
from phd_exp.fusion.tracks import (
    ConstantVelocity,
    Lost,
    Slow,
    correlation_time,
    estimated,
    standardised_errors,
    track,
)
from phd_exp.fusion.tracks.gaussian import _tilted_projection
from phd_exp.fusion.tracks.slow import weights
from phd_exp.metrics.errors import squared_mahalanobis
from tests.support.paths import NO_ERRORS, Errors, around, drawn_paths

LAW, TIMES = ConstantVelocity(noise=0.3, speed=0.3), np.arange(60) / 30
NEVER = Lost(contradictions=10**6)
DEPTH = Errors(deviation=0.05, depth_time=1.0)  # 38 % of the variance
BOTH = Errors(0.05, 1.0, share=0.4, projection_time=0.5)


@pytest.mark.parametrize(("a", "rounding"), [(3.0, 0.0), (20.0, 0.0), (100.0, 0.0), (20.0, 2.0)])
def test_one_frame_has_the_moments_of_its_density(a: float, rounding: float) -> None:
    one = torch.ones(1, 1).double()
    A = 100 * torch.tensor([[2.0, 0.5], [0.5, 1.0]]).double().expand(1, 1, 2, 2)
    density = ProjectedHuber(torch.tensor([[[0.05, -0.02]]]).double(), 4 * one, A, a * one, rounding=rounding)
    path = track(torch.zeros(1), density, around(1), LAW)
    off = squared_mahalanobis(path.mean - density.mean[:, 0], density.covariance_matrix[:, 0])
    ratios = torch.linalg.eigvals(torch.linalg.solve(density.covariance_matrix[0, 0], path.covariance[0])).real
    assert off.sqrt().max() < 0.01
    assert (ratios - 1).abs().max() < 0.006


@pytest.mark.parametrize("variance", [0.5, 5.0, 20.0, 1e3])
@pytest.mark.parametrize("place", [0.0, 2.0, 4.0])
def test_moments_of_a_projection_are_those_of_a_grid(place: float, variance: float) -> None:
    """The law of q where the other frames say Normal(place, variance): mean and variances in units of their own."""
    half = 12 * max(1.0, min(variance, 4.0) ** 0.5)
    x, y = np.meshgrid(np.linspace(-half, half, 801) + place, np.linspace(-half, half, 801), indexing="ij")
    squared = x * x + y * y
    energy = np.where(squared < 1, squared / 2, np.sqrt(squared) - 0.5) + ((x - place) ** 2 + y * y) / (2 * variance)
    weight = np.exp(-energy) / np.exp(-energy).sum()
    mean = (weight * x).sum()
    S = (weight * (x - mean) ** 2).sum(), (weight * y * y).sum()
    factor = np.array([1 / S[0] - 1 / variance, 0, 1 / S[1] - 1 / variance, 0, mean / S[0] - place / variance, 0, 0])
    _, z_x, _, Z_xx, _, Z_yy = _tilted_projection(mean, 0.0, S[0] ** 0.5, 0.0, S[1] ** 0.5, 1.0, factor)
    assert abs(z_x) < 0.01
    assert max(abs(Z_xx - 1), abs(Z_yy - 1)) < 0.025


def nees(n: int, used: Slow, *, cameras: int = 1, errors: Errors = NO_ERRORS, seed: int = 0) -> tuple[float, float]:
    """Squared Mahalanobis distances over 3, averaged over each of n paths: their mean, and half its 95 % interval."""
    pose = around(cameras)
    drawn, truth = drawn_paths(n, TIMES, LAW, pose, errors=errors, seed=seed)
    found = []
    for i in range(n):
        path = track(torch.from_numpy(TIMES), drawn[i], pose, LAW, slow=used, lost=NEVER)
        found.append(float(squared_mahalanobis(truth[i] - path.mean, path.covariance).mean()) / 3)
    return float(np.mean(found)), float(stats.sem(found) * stats.t.ppf(0.975, n - 1))


@pytest.mark.parametrize("cameras", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_independent_errors_are_within_their_covariance(cameras: int) -> None:
    mean, half = nees(100, Slow(), cameras=cameras)
    assert abs(mean - 1) < half < 0.1


@pytest.mark.parametrize(
    ("errors", "slow", "cameras"),
    [
        (DEPTH, Slow(0.38), 1),
        pytest.param(BOTH, Slow(0.38, 0.2), 1, marks=pytest.mark.slow),
        pytest.param(Errors(share=0.4, projection_time=0.5), Slow(0.0, 0.2), 2, marks=pytest.mark.slow),
    ],
)
def test_slow_errors_are_about_within_the_covariance_if_frames_have_weights_and_outside_if_not(
    errors: Errors, slow: Slow, cameras: int
) -> None:
    mean, half = nees(60 // cameras, slow, errors=errors, cameras=cameras)
    assert abs(mean - 1) < 0.35
    ignored, half = nees(30, Slow(), errors=errors, cameras=cameras)
    assert ignored - half > 1.5


@pytest.mark.parametrize(("tilt", "most"), [(0.0, 0.1), (0.1, 0.25)])
@pytest.mark.parametrize("noise", [0.1, 1.0])
def test_motion_and_projections_do_not_tell_the_distance(noise: float, tilt: float, most: float) -> None:
    """A steady object at 4 m, whose directions err: the depth stays that of the predictions, whatever the noise.

    With free axes, which cross where the predictions are right, it may move a little more.
    """
    times, generator = torch.arange(40).double() / 30, torch.Generator().manual_seed(0)
    mu_xy = 0.01 * torch.randn(40, 1, 2, generator=generator).double()
    mu_xy[..., 0] += 0.1 * torch.sin(4 * times)[:, None]
    A = 300 * torch.eye(2).double().expand(40, 1, 2, 2)
    mu_z, a = torch.full((40, 1), 4.0).double(), torch.full((40, 1), 10.0).double()
    k = tilt * torch.randn(40, 1, 2, generator=generator).double() if tilt else None
    predictions = ProjectedHuber(mu_xy, mu_z, A, a, k=k)
    path = track(times, predictions, around(1), ConstantVelocity(noise, speed=0.3), slow=Slow(depth_time=3.0))
    deviation = predictions.depth_variance[0, 0].sqrt()
    assert (path.mean[:, 2] - predictions.depth_mean[0, 0]).abs().max() < most * deviation
    without = track(times, predictions, around(1), ConstantVelocity(noise, speed=0.3), slow=Slow(depth_time=1e-9))
    assert without.mean[:, 2].mean() < 4.2


def test_weights_are_those_of_the_best_mean_of_a_process() -> None:
    """The rows of the inverse correlation matrix; masked frames do not count."""
    times = np.cumsum(np.random.default_rng(0).uniform(0.01, 0.2, 12))
    seen = np.arange(12) != 5
    since = np.concatenate([[np.inf], np.diff(times)])
    since[6] += since[5]
    found = weights(0.3, since[:, None], seen[:, None])[:, 0]
    correlation = np.exp(-abs(times[seen, None] - times[seen]) / 0.3)
    np.testing.assert_allclose(found[seen], np.linalg.solve(correlation, np.ones(11)), rtol=1e-9)
    assert found[5] == 0
    np.testing.assert_array_equal(weights(0.0, since[:, None], seen[:, None])[:, 0], seen)


def test_the_time_constant_of_slow_errors_is_found() -> None:
    drawn, truth = drawn_paths(200, TIMES, LAW, around(1), errors=BOTH, seed=5)
    depth, projection = standardised_errors(drawn, around(1).into_camera(truth[:, :, None]))
    times = [TIMES] * 200
    assert 0.38 / 3 < correlation_time(times, list(depth[..., 0].numpy())) < 0.38 * 1.5  # of 38 % over 1 s
    both = [*projection[..., 0, 0].numpy(), *projection[..., 0, 1].numpy()]
    assert 0.2 / 3 < correlation_time(times * 2, both) < 0.2 * 1.5
    with pytest.raises(ValueError, match=r"^times: got 1 sequences of one frame at most; expected"):
        correlation_time([TIMES[:1]], [TIMES[:1]])


def test_the_noise_of_the_motion_is_found() -> None:
    drawn, _ = drawn_paths(4, np.arange(100) / 30, ConstantVelocity(0.5, speed=0.3), around(2), seed=7)
    times = torch.arange(100).double() / 30
    found = [estimated(times, drawn[i], around(2), ConstantVelocity(3.0, speed=0.3)).noise for i in range(4)]
    assert 0.3 < np.exp(np.mean(np.log(found))) < 0.8

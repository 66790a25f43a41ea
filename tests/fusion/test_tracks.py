"""Paths held against a conic solver, Kalman smoothers and dense matrices; outliers, gaps, ends and bad input."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from filterpy.kalman import KalmanFilter
from scipy.integrate import trapezoid
from torch import Tensor

from phd_exp.distributions import PointEstimate, ProjectedHuber
from phd_exp.fusion import Pose
from phd_exp.fusion.tracks import ConstantAcceleration, ConstantVelocity, Gaussian, Lost, Slow, track
from phd_exp.fusion.tracks.motion import transitions
from phd_exp.geometry import Camera, DepthScale
from phd_exp.geometry.charts import Cartesian
from tests.support.conic_path import PathProgram, motion, noise
from tests.support.paths import around, drawn_paths

NEVER = Lost(after=math.inf, contradictions=10**6)


def irregular(frames: int, seed: int) -> np.ndarray:
    """Times between frames from 10 to 100 ms, and one gap of half a second."""
    steps = np.random.default_rng(seed).uniform(0.01, 0.1, frames - 1)
    steps[frames // 2] = 0.5
    return np.concatenate([[0.0], np.cumsum(steps)])


def with_outliers(predictions: ProjectedHuber, share: float, seed: int) -> ProjectedHuber:
    """The predictions, a share of them wrong far beyond their uncertainty.

    With an odd seed they have a free axis, with a multiple of 3 a rounded mode.
    """
    generator = torch.Generator().manual_seed(seed)
    shape = predictions.batch_shape
    wild = (torch.rand(shape, generator=generator) < share).double()
    mu_xy = predictions.mu_xy + 0.1 * wild[..., None] * torch.randn(*shape, 2, generator=generator).double()
    mu_z = predictions.mu_z * (0.5 * wild * torch.randn(shape, generator=generator).double()).exp()
    k = 0.5 * torch.randn(*shape, 2, generator=generator).double() if seed % 2 else None
    return ProjectedHuber(mu_xy, mu_z, predictions.A, predictions.a, k, rounding=0.0 if seed % 3 else 2.0)


@pytest.mark.parametrize("cameras", [1, 2])
def test_the_path_is_that_of_a_conic_solver(cameras: int) -> None:
    """30 paths in all with outliers, hidden frames and irregular times: at most 1e-9 nats above the conic optimum."""
    pose, law = around(cameras), ConstantVelocity(noise=0.7, speed=0.5)
    for seed in range(15):
        times = irregular(12 + 2 * seed, seed)
        drawn, _ = drawn_paths(1, times, law, pose, a=5.0 + 4 * seed, A=100.0 + 20 * seed, seed=seed)
        predictions = with_outliers(drawn[0], 0.1, seed)
        mask = torch.rand(len(times), cameras, generator=torch.Generator().manual_seed(seed)) > 0.2
        mask[0] = True
        program = PathProgram(times, predictions, pose, mask, law.noise, law.speed)
        path = track(torch.from_numpy(times), predictions, pose, law, mask, lost=NEVER)
        ours = torch.cat([path.point, path.velocity], -1).numpy()
        theirs = [program.solve(tolerance) for tolerance in (1e-9, 1e-11)]
        best = min(map(program.energy, theirs))
        above = float(program.energy(ours) - best)
        distance = min(np.abs(ours - x)[:, :3].max() for x in theirs)
        assert above <= 1e-9
        assert distance < 1e-4


def smoothed(times: np.ndarray, means: np.ndarray, covariances: np.ndarray, law: ConstantVelocity) -> Any:
    """Means and covariances of (position, velocity) by filterpy's filter and Rauch-Tung-Striebel smoother.

    The first prediction and the law of the velocity are its start, because nothing else is known of the position.
    """
    H = np.eye(3, 6)
    kalman = KalmanFilter(dim_x=6, dim_z=3)
    kalman.x = np.append(means[0], np.zeros(3))
    kalman.P = np.zeros((6, 6))
    kalman.P[:3, :3], kalman.P[3:, 3:] = covariances[0], law.speed**2 * np.eye(3)
    kalman.H = H
    x, P = [kalman.x.copy()], [kalman.P.copy()]
    F, Q = [motion(step) for step in np.diff(times)], [noise(step, law.noise) for step in np.diff(times)]
    for k in range(1, len(times)):
        kalman.predict(F=F[k - 1], Q=Q[k - 1])
        kalman.update(means[k], R=covariances[k])
        x.append(kalman.x.copy())
        P.append(kalman.P.copy())
    return kalman.rts_smoother(np.array(x), np.array(P), Fs=[F[0], *F], Qs=[Q[0], *Q])[:2]


def test_gaussian_predictions_give_the_rauch_tung_striebel_smoother() -> None:
    law, times = ConstantVelocity(noise=0.5, speed=1.0), irregular(40, 3)
    drawn, _ = drawn_paths(1, times, law, around(1), seed=3)
    predictions = Gaussian.of(drawn[0])
    path = track(torch.from_numpy(times), predictions, around(1), law, lost=NEVER)
    mean, covariance = smoothed(times, predictions.mean[:, 0].numpy(), predictions.covariance[:, 0].numpy(), law)
    np.testing.assert_allclose(path.point, mean[:, :3], rtol=0, atol=1e-8)
    np.testing.assert_allclose(path.mean, mean[:, :3], rtol=0, atol=1e-8)
    np.testing.assert_allclose(path.velocity, mean[:, 3:], rtol=0, atol=1e-8)
    np.testing.assert_allclose(path.covariance, covariance[:, :3, :3], rtol=0, atol=1e-8)
    np.testing.assert_allclose(path.velocity_covariance, covariance[:, 3:, 3:], rtol=0, atol=1e-8)


def test_the_noise_of_both_motions_is_that_of_integrated_white_noise() -> None:
    step = 0.3
    F, W = transitions(ConstantVelocity(0.7), np.array([step]))
    np.testing.assert_allclose(np.kron(F[0], np.eye(3)), motion(step))
    np.testing.assert_allclose(np.kron(np.linalg.inv(W[0]), np.eye(3)), noise(step, 0.7))
    F, W = transitions(ConstantAcceleration(0.7), np.array([step]))
    fine = np.linspace(0, step, 20001)
    influence = np.stack([(step - fine) ** 2 / 2, step - fine, np.ones_like(fine)])  # of a jerk at that time
    expected = 0.49 * trapezoid(influence[:, None] * influence[None], fine)
    np.testing.assert_allclose(np.linalg.inv(W[0]), expected, rtol=1e-6)
    np.testing.assert_allclose(F[0], [[1, step, step**2 / 2], [0, 1, step], [0, 0, 1]])


def steady(frames: int, cameras: int = 1) -> tuple[Tensor, ProjectedHuber, Pose, Tensor]:
    """An object at constant velocity with predictions that err little."""
    times = torch.arange(frames).double() / 30
    truth = torch.stack([0.3 * times, -0.1 * times, 4 + 0.2 * times], -1)
    generator, pose = torch.Generator().manual_seed(0), around(cameras)
    v = pose.into_camera(truth[:, None])
    mu_xy = v[..., :2] / v[..., 2:] + 0.002 * torch.randn(*v.shape[:-1], 2, generator=generator).double()
    mu_z = v[..., 2] * (1 + 0.02 * torch.randn(v.shape[:-1], generator=generator).double())
    A = 300 * torch.eye(2).double().expand(*mu_z.shape, 2, 2)
    return times, ProjectedHuber(mu_xy, mu_z, A, torch.full_like(mu_z, 50.0)), pose, truth


LAW = ConstantVelocity(noise=0.3)


def test_an_outlier_shows_and_does_not_bend_the_path() -> None:
    times, predictions, pose, _ = steady(30)
    mu_xy = predictions.mu_xy.clone()
    mu_xy[12] += 0.15  # 60 cm
    wrong = ProjectedHuber(mu_xy, predictions.mu_z, predictions.A, predictions.a)
    path, without = track(times, wrong, pose, LAW), track(times, predictions, pose, LAW)
    assert path.lost is None
    assert path.surprise[12] > 1 - 1e-9
    assert np.delete(path.surprise.numpy(), 12).max() < 0.99
    bent = (path.point - without.point).norm(dim=-1).max()
    gaussian = track(times, Gaussian.of(wrong), pose, LAW, lost=NEVER).point - without.point
    assert bent < 0.2 * gaussian.norm(dim=-1).max()


def test_a_gap_is_bridged_with_growing_covariance() -> None:
    times, predictions, pose, truth = steady(30)
    mask = torch.ones(30, 1, dtype=torch.bool)
    mask[10:20] = False
    mu_z = predictions.mu_z.clone()
    mu_z[10:20] = torch.nan  # masked out
    hidden = ProjectedHuber(predictions.mu_xy, mu_z, predictions.A, predictions.a, validate_args=False)
    path = track(times, hidden, pose, LAW, mask)
    variance = path.covariance.diagonal(dim1=-2, dim2=-1).sum(-1)
    assert (variance[9:15].diff() > 0).all()
    assert (variance[15:21].diff() < 0).all()
    assert (path.surprise.isnan() == ~mask).all()
    assert (path.point - truth).norm(dim=-1).max() < 0.1
    ends = track(times, hidden, pose, LAW, mask, lost=Lost(after=0.25))
    assert ends.lost == "lost after 0.3 s: no prediction for more than 0.25 s"
    assert ends.point[:16].isfinite().all()
    assert ends.point[18:].isnan().all()


def test_frames_that_contradict_the_path_end_the_track() -> None:
    times, predictions, pose, _ = steady(60)
    mu_xy = predictions.mu_xy.clone()
    mu_xy[50:] += 0.2  # another object, from 1.67 s on
    path = track(times, ProjectedHuber(mu_xy, predictions.mu_z, predictions.A, predictions.a), pose, LAW)
    end = int(path.point[:, 0].isfinite().sum())  # Huber tails let some frames pull the path over before
    assert 44 <= end <= 50
    assert path.lost == f"lost at {times[end]:g} s: from then on 5 frames in a row contradict the path"
    alone = track(times[:end], predictions[0:end], pose, LAW)
    torch.testing.assert_close(path.point[:end], alone.point, rtol=0, atol=1e-9)
    assert path.covariance[end:].isnan().all()


def test_frames_before_the_first_prediction_are_not_part_of_the_track() -> None:
    times, predictions, pose, _ = steady(20)
    mask = (torch.arange(20) >= 5)[:, None]
    path = track(times, predictions, pose, LAW, mask)
    assert path.point[:5].isnan().all()
    torch.testing.assert_close(path.mean[5:], track(times[5:], predictions[5:20], pose, LAW).mean)


def bad(**changes: Any) -> dict[str, Any]:
    times, predictions, pose, _ = steady(4)
    return {"times": times, "predictions": predictions, "pose": pose, "motion": LAW} | changes


def changed(tensor: Tensor, index: Any, value: Any) -> Tensor:
    """A copy with other numbers at an index."""
    tensor = tensor.clone()
    tensor[index] = value
    return tensor


DEPTH = DepthScale.from_ranges(f_range=(1200.0, 2000.0), z_range=(3.0, 5.0))
POINTS = PointEstimate(torch.zeros(4, 1, 3), Cartesian(DEPTH), Camera(torch.tensor(1500.0), 224.0))


def bad_input() -> dict[str, tuple[dict[str, Any], str]]:
    times, predictions, pose, _ = steady(4)
    R, t = pose.R.expand(4, 1, 3, 3), pose.t.expand(4, 1, 3)
    broken = ProjectedHuber(
        predictions.mu_xy, changed(predictions.mu_z, 2, torch.nan), predictions.A, predictions.a, validate_args=False
    )
    return {
        "repeated": (bad(times=changed(times, 2, times[1])), r"times: got 0.03.* in frame 2 after 0.03.*; expected"),
        "backward": (bad(times=times.flip(0)), r"times: got 0.06.* in frame 1 after 0.1; expected increasing"),
        "not finite": (bad(times=changed(times, 1, torch.nan)), r"times: got nan in frame 1; expected finite"),
        "too few times": (bad(times=times[:3]), r"times: got shape \(3,\); expected \(4,\)"),
        "no frames": (bad(times=times[:0], predictions=predictions[0:0]), r"predictions: got batch "),
        "no cameras": (bad(predictions=predictions[:, 0]), r"predictions: got batch shape"),
        "poses missing": (bad(pose=Pose(R[:3], t[:3])), r"pose.R: got batch shape \(3, 1\); expected one that"),
        "a pose is missing": (bad(pose=Pose(changed(R, 3, torch.nan), t)), r"frame 3: a prediction, pose"),
        "no rotation": (bad(pose=Pose(1.01 * R, t)), r"frame 0: the R of a pose is not a rotation to 1e-6; exp"),
        "a prediction": (bad(predictions=broken), r"frame 2: a prediction, pose or plane is not finite"),
        "nothing": (bad(mask=torch.zeros(4, 1, dtype=torch.bool)), r"mask: got no prediction in any frame"),
        "a baseline": (bad(predictions=POINTS), r"predictions: got PointEstimate; expected Projected"),
        "slow": (bad(predictions=Gaussian.of(predictions), slow=Slow(0.5)), r"slow: got Gaussian predictions; exp"),
        "singular": (
            bad(predictions=Gaussian(predictions.mean, 0 * predictions.covariance_matrix)),
            r"frame 0: a prediction, pose or plane is not finite",
        ),
        "behind": (
            bad(pose=Pose(torch.stack([R[0, 0], torch.diag(torch.tensor([1.0, -1, -1]).double())]), 0 * t[:1, 0]),
                predictions=predictions.expand((4, 2))),
            r"predictions: no position is in front of every camera",
        ),
    }  # fmt: skip


@pytest.mark.parametrize("case", bad_input())
def test_bad_input_is_refused_on_one_line(case: str) -> None:
    arguments, message = bad_input()[case]
    with pytest.raises(ValueError, match=rf"^{message}") as raised:
        track(**arguments)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ConstantVelocity(noise=0.0), "noise: got 0.0; expected a positive number"),
        (lambda: replace(ConstantAcceleration(1.0), acceleration=math.inf), "acceleration: got inf; expected"),
        (lambda: Slow(depth_time=math.inf), "depth_time: got inf; expected a number of seconds, 0 for"),
        (lambda: Slow(projection_time=-1.0), "projection_time: got -1.0; expected a number of seconds"),
        (lambda: Lost(after=0.0), "after: got 0.0; expected a positive number of seconds"),
        (lambda: Lost(contradictions=0), "contradictions: got 0; expected a number of frames"),
        (lambda: Lost(probability=1.0), "probability: got 1.0; expected a probability"),
    ],
)
def test_numbers_out_of_range_are_refused(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}"):
        make()

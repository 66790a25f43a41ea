"""Compares ways to smooth the predictions of sequences: errors and calibration of the paths."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float
from scipy import optimize, stats
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.columns import from_columns
from phd_exp.evaluation.point_errors import SEED
from phd_exp.evaluation.predictions import Curve, scalar_bands
from phd_exp.evaluation.several_views import SeveralViews
from phd_exp.fusion import Pose, Status, fuse
from phd_exp.fusion.tracks import ConstantVelocity, Gaussian, Lost, Path, Slow, correlation_time, standardised_errors
from phd_exp.fusion.tracks import track as smoothed
from phd_exp.hardware import one_thread
from phd_exp.metrics.bootstrap import Interval, bands
from phd_exp.metrics.errors import MILLIMETRES, depth_error, projected_error, squared_mahalanobis
from phd_exp.records.errors import RunError

Cameras = Sequence[SeveralViews]
"""The same sequences from each camera; their views are frames."""
Method = Literal["single", "kalman", "independent", "slow"]
"""Each frame alone (its mode, or the position fused from two cameras); a Rauch-Tung-Striebel smoother of means and
covariances; the mean path of `fusion.tracks.track` without and with slow errors."""
METHODS: tuple[Method, ...] = ("single", "kalman", "independent", "slow")
SMOOTHERS = METHODS[1:]
ERRORS = ("depth_error_mm", "projected_error_mm")
NEES = "nees"
HIDDEN = 0.3  # visibility below which the object counts as hidden
WHOLE = Lost(after=math.inf, probability=0.0)  # no track ends early: all methods have the same frames
NOISES = (0.01, 100.0)  # m/s^2 per sqrt(Hz), among which the noise of the motion is chosen
PRECISION = 0.05  # of its logarithm
OUTLYING = 0.05  # share of the held-out sequences of several cameras that do not count for their NEES
FACTORS = (1 / 8, 1 / 4, 1 / 2, 1.0, 2.0, 4.0, 8.0)  # of the noise and the time constants of paths with slow errors


@dataclass(frozen=True)
class Choice:
    """What held-out sequences choose.

    Attributes:
        noise: of each smoother's motion, m/s^2 per sqrt(Hz).
        speed: of the motion in the first frame, m/s.
        slow: the slow errors of the smoother.
        correlated: those by the autocorrelation of standardised errors.
    """

    noise: dict[Method, float]
    speed: float
    slow: Slow
    correlated: Slow


@dataclass(frozen=True)
class TrackScores:
    """Scores of n sequences of one or two cameras.

    Attributes:
        n, frames, hidden: number of sequences, of frames in each, and of all frames that hide the object from the
            first camera.
        left_out: further sequences, with a value that is not finite or without a path in front of the camera.
        choice: of the held-out sequences.
        bands: by `place`, means over frames with 95 % bootstrap intervals over sequences. `nees` is the squared
            Mahalanobis distance over 3, 1 on average if calibrated; `hidden/` is of the hidden frames alone, absent
            without one; `ratio/` is the mean error over that of single frames; `gain/` is the mean depth error of
            the Kalman smoother minus that of a method, mm.
        curves: by `place`, means over sequences at each time (s).
        calibrated: 95 % interval of the mean NEES of n frames, one of each sequence, if calibrated.
        cameras: number of cameras.
    """

    n: int
    frames: int
    hidden: int
    left_out: int
    choice: Choice
    bands: dict[str, Interval[float]]
    curves: dict[str, Curve]
    calibrated: tuple[float, float]
    cameras: int = 1

    @property
    def name(self) -> str:
        """The length of the sequences and the number of cameras, in words."""
        return f"{self.frames} frames" + (f", {self.cameras} cameras" if self.cameras > 1 else "")


def place(quantity: str, method: Method) -> str:
    """The key of a number or curve."""
    return f"{quantity}/{method}"


def choose(held_out: Sequence[Cameras]) -> Choice:
    """The motion and the slow errors, chosen on held-out sequences from as many cameras as those of the test.

    The speed is that of the true positions. The noise of smoothers of independent frames makes the predictions most
    likely. With slow errors, where the predictions hardly tell the noise, it makes the true positions most likely
    under the path's covariances, as do both time constants, among `FACTORS` times those of the autocorrelation. The
    likelihood is that of Gaussians, in which one sequence with a wrong object in all cameras outweighs many others.
    With several cameras, where such sequences are rare, both time constants are therefore changed by one factor, so
    that the mean NEES is 1 without the share `OUTLYING` of the sequences, those of the largest NEES.

    Raises RunError if no sequence has a path.
    """
    start, speed = correlated(held_out), _speed(held_out)
    found = Choice({}, speed, start, start)
    with one_thread():
        noise = {method: _noise(held_out, found, method) for method in SMOOTHERS[:2]}
        found = replace(found, noise=noise | {"slow": noise["independent"]})
        for change in (_with_noise, _with_depth_time, _with_projection_time, _with_noise):
            found = min((change(found, factor) for factor in FACTORS), key=lambda one: _surprisal(held_out, one))
        return _calibrated(held_out, found) if len(held_out[0]) > 1 else found


def _with_noise(choice: Choice, factor: float) -> Choice:
    return replace(choice, noise=choice.noise | {"slow": factor * choice.noise["slow"]})


def _with_depth_time(choice: Choice, factor: float) -> Choice:
    return replace(choice, slow=replace(choice.slow, depth_time=factor * choice.slow.depth_time))


def _with_projection_time(choice: Choice, factor: float) -> Choice:
    return replace(choice, slow=replace(choice.slow, projection_time=factor * choice.slow.projection_time))


def _surprisal(held_out: Sequence[Cameras], choice: Choice) -> float:
    """-log density of the true positions under the Gaussians of paths with slow errors, up to a constant."""
    found = sum(float((distance + spread).sum()) / 2 for distance, spread in _at_truth(held_out, choice))
    return found if math.isfinite(found) else math.inf


def _at_truth(held_out: Sequence[Cameras], choice: Choice) -> Iterator[tuple[Tensor, Tensor]]:
    """The squared Mahalanobis distance of the truth and the log determinant of the covariance in each frame."""
    for cameras in held_out:
        truth = cameras[0].pose.into_world(cameras[0].xyz)
        for row, path in enumerate(_paths(cameras, "slow", choice)):
            if path:
                distance = squared_mahalanobis(truth[row] - path.mean, path.covariance)
                yield distance, torch.linalg.slogdet(path.covariance)[1]


def _calibrated(held_out: Sequence[Cameras], choice: Choice) -> Choice:
    """With time constants whose mean NEES is nearest to 1 without outlying sequences."""

    def changed(log_factor: float) -> Choice:
        factor = math.exp(log_factor)
        return _with_depth_time(_with_projection_time(choice, factor), factor)

    def loss(log_factor: float) -> float:
        nees = sorted(float(distance.mean()) / 3 for distance, _ in _at_truth(held_out, changed(log_factor)))
        kept = nees[: max(1, int((1 - OUTLYING) * len(nees)))]
        return abs(math.log(sum(kept) / len(kept)))

    bounds = math.log(FACTORS[0]), math.log(FACTORS[-1])
    return changed(optimize.minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": PRECISION}).x)


def _speed(held_out: Sequence[Cameras]) -> float:
    """Root mean square of the velocity of the true positions along an axis, m/s."""
    squares = []
    for one, *_ in held_out:
        moved = one.pose.into_world(one.xyz).diff(dim=1) / one.columns["time"].diff(dim=1)[..., None]
        squares.append(moved.square().flatten())
    return float(torch.cat(squares).mean().sqrt())


def correlated(held_out: Sequence[Cameras]) -> Slow:
    """The time constants by the autocorrelation of the standardised errors of all cameras."""
    every = [one for cameras in held_out for one in cameras]
    times = [row for one in every for row in one.columns["time"].numpy()]
    both = [standardised_errors(one.predictions, one.xyz) for one in every]
    depth = [row for errors, _ in both for row in errors.numpy()]
    across = [row for _, errors in both for axis in errors.unbind(-1) for row in axis.numpy()]
    of_axes = [row for one in every for _ in range(2) for row in one.columns["time"].numpy()]
    return Slow(correlation_time(times, depth), correlation_time(of_axes, across))


def _noise(held_out: Sequence[Cameras], known: Choice, method: Method) -> float:
    """The noise of highest total `log_evidence`."""

    def loss(log_noise: float) -> float:
        choice = replace(known, noise={method: math.exp(log_noise)})
        found = [path.log_evidence for cameras in held_out for path in _paths(cameras, method, choice) if path]
        if not found:
            raise RunError("sequences: not one held-out sequence has a path; train longer")
        return -sum(found)

    bounds = math.log(NOISES[0]), math.log(NOISES[1])
    return math.exp(optimize.minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": PRECISION}).x)


def _together(cameras: Cameras) -> tuple[ProjectedHuber, Pose]:
    """Predictions and poses (sequences, frames, cameras)."""
    columns = {name: torch.stack([one.columns[name] for one in cameras], -1) for name in cameras[0].columns}
    R, t = (torch.stack([getattr(one.pose, name) for one in cameras], 2) for name in "Rt")
    return from_columns(columns), Pose(R, t)


def _paths(cameras: Cameras, method: Method, choice: Choice) -> Iterator[Path | None]:
    """The path of each sequence; None where there is none in front of the cameras."""
    predictions, poses = _together(cameras)
    motion = ConstantVelocity(choice.noise[method], choice.speed)
    slow = choice.slow if method == "slow" else Slow()
    for row, times in enumerate(cameras[0].columns["time"]):
        pose = Pose(poses.R[row], poses.t[row])
        given = Gaussian.of(predictions[row]) if method == "kalman" else predictions[row]
        try:
            yield smoothed(times, given, pose, motion, slow=slow, lost=WHOLE)
        except ValueError:
            yield None


def track_scores(cameras: Cameras, choice: Choice, resamples: int = 1000) -> TrackScores:
    """Smooth with every method and score, in the frame of the first camera.

    Raises RunError if no sequence has a path by all of them.
    """
    paths = {method: list(_paths(cameras, method, choice)) for method in SMOOTHERS}
    alone = fuse(*_together(cameras), contradiction=0.0)
    sound = torch.tensor([all(each) for each in zip(*paths.values(), strict=True)])
    sound &= (alone.status == Status.FUSED).all(-1)
    if not bool(sound.any()):
        raise RunError("sequences: not one has a path by every method; train longer")
    kept = cameras[0].subset(sound)
    found = _scored(kept, "single", *(values[sound] for values in (alone.point, alone.mean, alone.covariance)))
    for method, of_all in paths.items():
        whole = [path for path, good in zip(of_all, sound, strict=True) if path and good]
        mean = torch.stack([path.mean for path in whole])
        found |= _scored(kept, method, mean, mean, torch.stack([path.covariance for path in whole]))
    hidden = (kept.columns["visibility"] < HIDDEN).double()
    times, n = kept.columns["time"][0].tolist(), kept.n
    low, high = stats.chi2.ppf((0.025, 0.975), 3 * n) / (3 * n)
    return TrackScores(
        n=n,
        frames=kept.views,
        hidden=int(hidden.sum()),
        left_out=kept.left_out,
        choice=choice,
        bands=scalar_bands(_means, found | {"hidden": hidden}, resamples),
        curves={
            at: Curve(times, *(getattr(band, end).tolist() for end in ("value", "low", "high")))
            for at, band in bands(_over_time, found, resamples, SEED).items()
        },
        calibrated=(float(low), float(high)),
        cameras=len(cameras),
    )


def _scored(
    sequences: SeveralViews,
    method: Method,
    point: Float[Tensor, "sequences frames 3"],
    mean: Float[Tensor, "sequences frames 3"],
    covariance: Float[Tensor, "sequences frames 3 3"],
) -> dict[str, Float[Tensor, "sequences frames"]]:
    """The errors of positions in the world, and the NEES of means and covariances, in each frame."""
    xyz, estimate = sequences.xyz, sequences.pose.into_camera(point)
    errors: tuple[Callable[..., Tensor], ...] = depth_error, projected_error
    found = {place(name, method): MILLIMETRES * of(xyz, estimate) for name, of in zip(ERRORS, errors, strict=True)}
    truth = sequences.pose.into_world(xyz)
    return found | {place(NEES, method): squared_mahalanobis(truth - mean, covariance) / 3}


def _means(columns: Mapping[str, Tensor], counts: Tensor) -> dict[str, Tensor]:
    """The statistic of all `bands`, given the columns of `_scored` and which frames are hidden."""
    hidden = columns["hidden"]
    weight, frames = counts @ hidden.sum(-1), counts.sum(-1)
    found = {name: counts @ column.mean(-1) / frames for name, column in columns.items() if name != "hidden"}
    if bool(hidden.any()):
        of_hidden = {name: counts @ (column * hidden).sum(-1) / weight for name, column in columns.items()}
        found |= {f"hidden/{name}": value for name, value in of_hidden.items() if name != "hidden"}
    single = {name: value for name, value in found.items() if name.endswith("/single") and NEES not in name}
    for name, value in single.items():
        quantity = name.removesuffix("/single")
        found |= {f"ratio/{place(quantity, method)}": found[place(quantity, method)] / value for method in SMOOTHERS}
    kalman = found[place(ERRORS[0], "kalman")]
    return found | {place("gain", method): kalman - found[place(ERRORS[0], method)] for method in SMOOTHERS[1:]}


def _over_time(columns: Mapping[str, Tensor], counts: Tensor) -> dict[str, Tensor]:
    return {name: counts @ column / counts.sum(-1, keepdim=True) for name, column in columns.items()}

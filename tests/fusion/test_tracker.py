"""The tracker against the smoother of whole sequences."""

import math

import numpy as np
import pytest
import torch

from phd_exp.distributions import ProjectedHuber
from phd_exp.fusion import Pose
from phd_exp.fusion.tracks import ConstantVelocity, Gaussian, Lost, Slow, State, Tracker, track
from tests.support.paths import NO_ERRORS, Errors, around, drawn_paths

LAW, TIMES = ConstantVelocity(noise=0.3, speed=0.3), np.arange(40) / 30
NEVER = Lost(after=math.inf, contradictions=10**6)
POSE = around(1)


def drawn(errors: Errors = NO_ERRORS) -> ProjectedHuber:
    predictions, _ = drawn_paths(1, TIMES, LAW, POSE, errors=errors, seed=1)
    return predictions[0]


def fed(tracker: Tracker, predictions: ProjectedHuber | Gaussian, mask: torch.Tensor | None = None) -> list[State]:
    """All states, the last ones too."""
    states = []
    for k, time in enumerate(TIMES):
        if isinstance(predictions, Gaussian):
            frame: ProjectedHuber | Gaussian = Gaussian(predictions.mean[k], predictions.covariance[k])
        else:
            frame = predictions[k]
        states.append(tracker.update(float(time), frame, POSE, None if mask is None else mask[k]))
    return [state for state in states if state is not None] + tracker.finish()


@pytest.mark.parametrize("lag", [0, 5])
def test_gaussian_predictions_give_the_smoother_of_all_frames_up_to_the_lag(lag: int) -> None:
    gaussian = Gaussian.of(drawn())
    tracker = Tracker(LAW, lag, lost=Lost(contradictions=1, probability=0.0))
    states = fed(tracker, gaussian)
    assert [state.time for state in states] == pytest.approx(list(TIMES))
    for k in (0, 17, 39):
        known = slice(0, k + lag + 1)
        times, part = torch.from_numpy(TIMES[known]), Gaussian(gaussian.mean[known], gaussian.covariance[known])
        path = track(times, part, POSE, LAW, lost=NEVER)
        for name in ("point", "velocity", "mean", "covariance", "velocity_covariance"):
            torch.testing.assert_close(getattr(states[k], name), getattr(path, name)[k], rtol=0, atol=1e-9)


def test_a_lag_of_all_frames_gives_the_path_and_a_shorter_one_nearly() -> None:
    predictions = drawn()
    path = track(torch.from_numpy(TIMES), predictions, POSE, LAW, lost=NEVER)
    whole = fed(Tracker(LAW, 100), predictions)
    torch.testing.assert_close(torch.stack([state.point for state in whole]), path.point, rtol=0, atol=1e-7)
    torch.testing.assert_close(whole[7].surprise, path.surprise[7])
    states = fed(Tracker(LAW, 20), predictions)
    off = torch.stack([state.mean for state in states]) - path.mean
    squared = torch.einsum("ki,kij,kj->k", off, torch.linalg.inv(path.covariance), off)
    assert squared.max() < 1
    assert squared.mean() < 0.1


def test_slow_errors_weigh_the_frames_nearly_as_on_a_whole_path() -> None:
    slow, mask = Slow(0.4, 0.2), torch.ones(40, 1, dtype=torch.bool)
    mask[12:18] = False
    predictions = drawn(Errors(deviation=0.05, share=0.4))
    path = track(torch.from_numpy(TIMES), predictions, POSE, LAW, mask, slow, NEVER)
    whole = fed(Tracker(LAW, 100, slow), predictions, mask)
    off = torch.stack([state.mean for state in whole]) - path.mean  # the paths about which both are taken differ
    squared = torch.einsum("ki,kij,kj->k", off, torch.linalg.inv(path.covariance), off)
    assert squared.max() < 2
    assert squared.mean() < 0.5
    last = fed(Tracker(LAW, 10, slow), predictions, mask)[-1]
    off = last.mean - path.mean[-1]
    assert off @ torch.linalg.solve(path.covariance[-1], off) < 1
    ratios = torch.linalg.eigvals(torch.linalg.solve(path.covariance[-1], last.covariance)).real
    assert ratios.min() > 0.6
    assert ratios.max() < 1.7


def test_a_hidden_stretch_is_bridged_and_a_long_one_ends_the_track() -> None:
    predictions, mask = drawn(), torch.ones(40, 1, dtype=torch.bool)
    mask[:2] = mask[10:22] = False
    tracker = Tracker(LAW, 5)
    states = fed(tracker, predictions, mask)
    assert tracker.lost_because is None
    assert [state.time for state in states] == pytest.approx(list(TIMES[2:]))
    variances = [float(state.covariance.trace()) for state in states]
    assert variances[14] > 2 * variances[4]
    tracker = Tracker(LAW, 5, lost=Lost(after=0.3))
    states = fed(tracker, predictions, mask)
    assert tracker.lost_because == "lost after 0.3 s: no prediction for more than 0.3 s"
    assert states[-1].time < 0.7


def test_another_object_ends_the_track() -> None:
    right = drawn()
    mu_xy = right.mu_xy.clone()
    mu_xy[25:] += 0.2
    tracker = Tracker(LAW, 8)
    fed(tracker, ProjectedHuber(mu_xy, right.mu_z, right.A, right.a))
    assert tracker.lost_because is not None
    assert "5 frames in a row contradict the path" in tracker.lost_because
    assert tracker.update(10.0, right[0], POSE) is None


def test_bad_input_is_refused_on_one_line() -> None:
    tracker = Tracker(LAW)
    tracker.update(1.0, drawn()[0], POSE)
    with pytest.raises(ValueError, match=r"^time: got 1.0 after 1.0; expected a later time$"):
        tracker.update(1.0, drawn()[1], POSE)
    with pytest.raises(ValueError, match=r"^pose.R: got batch shape \(2,\); expected one that broadcasts to \(1,\)$"):
        tracker.update(1.1, drawn()[1], Pose(POSE.R.expand(2, 3, 3), POSE.t.expand(2, 3)))
    with pytest.raises(ValueError, match=r"^lag: got -1; expected"):
        Tracker(LAW, lag=-1)
    with pytest.raises(ValueError, match=r"^lag: got 0; expected a number of frames, at least 1$"):
        Tracker(LAW, lag=0, slow=Slow(1.0), lost=Lost(contradictions=1))
    with pytest.raises(ValueError, match=r"^lost.contradictions: got 5; expected at most lag \+ 1 = 3 frames$"):
        Tracker(LAW, lag=2)

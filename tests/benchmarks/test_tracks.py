"""How fast a path is smoothed, in comparison with a conic solver, and a live step."""

import time
from collections.abc import Callable
from statistics import median

import numpy as np
import pytest
import torch

from phd_exp.fusion.tracks import ConstantVelocity, Lost, Tracker, track
from tests.support.conic_path import PathProgram
from tests.support.paths import around, drawn_paths

pytestmark = pytest.mark.bench

FRAMES, LONG = 200, 1000
LEAST_RATIO = 3
"""Times faster than the conic solver, without the time in which the problem is written down for it."""
LAW = ConstantVelocity(noise=0.05, speed=0.02)


def seconds(task: Callable[[], object], rounds: int = 5) -> float:
    """Median processor time: both use one core, and others may want it too."""
    took = []
    for _ in range(rounds):
        begin = time.process_time()
        task()
        took.append(time.process_time() - begin)
    return median(took)


def test_a_path_is_far_faster_than_by_a_conic_solver(unchecked: None, record: Callable[..., None]) -> None:
    pose, times = around(1), np.arange(LONG) / 30
    drawn, _ = drawn_paths(1, times[:FRAMES], LAW, pose, seed=1)
    predictions = drawn[0]
    longer, _ = drawn_paths(1, times, ConstantVelocity(0.01, speed=0.01), pose, seed=1)
    program = PathProgram(
        times[:FRAMES], predictions, pose, torch.ones(FRAMES, 1, dtype=torch.bool), LAW.noise, LAW.speed
    )

    def solve() -> object:
        return track(torch.from_numpy(times[:FRAMES]), predictions, pose, LAW, lost=Lost(contradictions=LONG))

    def smooth() -> object:
        return track(torch.from_numpy(times), longer[0], pose, LAW, lost=Lost(contradictions=LONG)).covariance

    solve(), smooth()  # the first call loads what it needs
    ours, long = seconds(solve), seconds(smooth)
    theirs = seconds(lambda: program.solve(1e-9))
    tracker, steps = Tracker(LAW, lag=10), iter(range(FRAMES))
    step = seconds(lambda: tracker.update(times[k := next(steps)], predictions[k], pose), rounds=FRAMES)
    record(
        f"track, {FRAMES} frames of one camera",
        f"{1e3 * ours:.1f} ms; {LONG} frames with covariance {1e3 * long:.0f} ms; a live step {1e3 * step:.1f} ms",
        f"{1e3 * theirs:.0f} ms, Clarabel",
        f"{theirs / ours:.0f} times",
        str(LEAST_RATIO),
    )
    assert theirs / ours >= LEAST_RATIO

"""How fast a batch of fusion problems is solved, beside a conic solver that gets them one by one.

CPU times are processor seconds of one core, so that other work does not count.
"""

import time
from collections.abc import Callable
from statistics import median

import pytest
import torch

from phd_exp.distributions import ProjectedHuber
from phd_exp.fusion import Pose, fuse
from tests.fusion.conic import Program
from tests.fusion.random_problems import columns_of, random_problems
from tests.fusion.test_conic import cameras_of

pytestmark = pytest.mark.bench

CAMERAS, ONE_BY_ONE, ROUNDS = 4, 300, 5
BATCH = {"cpu": 10_000, "cuda": 200_000}
LEAST_RATIO = {"cpu": 10, "cuda": 100}
"""Times faster than the conic solver, its problems' set-up included."""


def seconds(task: Callable[[], object], device: str) -> float:
    """Processor time, or on a GPU the time until it is idle again."""
    clock = time.process_time if device == "cpu" else time.perf_counter
    start = clock()
    task()
    if device == "cuda":
        torch.cuda.synchronize()
    return clock() - start


def one_by_one() -> tuple[float, float]:
    """Clarabel's median seconds a problem: written down, set up and solved; and set up and solved alone."""
    predictions, pose, _ = random_problems(ONE_BY_ONE, CAMERAS, seed=1)
    origin = pose.into_world(predictions.mode).mean(1).numpy()
    whole, solving = [], []
    for i, problem in enumerate(cameras_of(predictions, pose)):
        start = time.process_time()
        program = Program(problem, origin[i], unit=1.0)
        written = time.process_time()
        program.solve(tolerance=1e-10)
        end = time.process_time()
        whole.append(end - start)
        solving.append(end - written)
    return median(whole), median(solving)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_a_batch_is_far_faster_than_one_by_one(
    device: str, unchecked: None, record: Callable[..., None]
) -> None:
    if device == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    n = BATCH[device]
    predictions, pose, _ = random_problems(n, CAMERAS, seed=2)
    predictions = ProjectedHuber(*(column.to(device) for column in columns_of(predictions)))
    pose = Pose(pose.R.to(device), pose.t.to(device))

    def solve() -> object:
        return fuse(predictions, pose)

    solve()  # the first call loads what it needs
    point = median(seconds(solve, device) for _ in range(ROUNDS)) / n
    moments = median(seconds(lambda: fuse(predictions, pose).covariance, device) for _ in range(ROUNDS)) / n
    whole, solving = one_by_one()
    record(
        f"fuse with certificate, {n} problems of {CAMERAS} cameras, {device}",
        f"{1e6 * point:.1f} us a problem, {1e6 * moments:.1f} us with covariance",
        f"{1e6 * whole:.0f} us, Clarabel, {1e6 * solving:.0f} us of it set-up and solution",
        f"{whole / point:.0f} and {solving / point:.0f} times",
        str(LEAST_RATIO[device]),
    )
    assert whole / point >= LEAST_RATIO[device]

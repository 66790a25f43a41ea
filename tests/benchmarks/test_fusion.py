"""How fast a batch of fusion problems is solved, beside a conic solver that gets them one by one.

What counts is the clock, on every core that there is; processor time stands beside it.
"""

import time
from collections.abc import Callable
from statistics import median

import pytest
import torch

from phd_exp.distributions import ProjectedHuber
from phd_exp.fusion import Pose, fuse
from tests.support.conic import Program, cameras_of
from tests.support.random_problems import columns_of, random_problems

pytestmark = pytest.mark.bench

CAMERAS, ONE_BY_ONE, ROUNDS = 4, 300, 5
BATCH = {"cpu": 10_000, "cuda": 200_000}
LEAST_RATIO = 100
"""Times faster than the conic solver, its problems' set-up included."""


def microseconds(task: Callable[[], object], device: str, n: int) -> tuple[float, float]:
    """Medians a problem, on the clock, until a GPU is idle again, and of processor time."""
    took = []
    for _ in range(ROUNDS):
        begin, start = time.perf_counter(), time.process_time()
        task()
        if device == "cuda":
            torch.cuda.synchronize()
        took.append((time.perf_counter() - begin, time.process_time() - start))
    clock, processor = zip(*took, strict=True)
    return 1e6 * median(clock) / n, 1e6 * median(processor) / n


def one_by_one() -> tuple[float, float]:
    """Clarabel's median microseconds a problem: written down, set up and solved; and set up and solved alone."""
    predictions, pose, _ = random_problems(ONE_BY_ONE, CAMERAS, seed=1)
    origin = pose.into_world(predictions.mode).mean(1).numpy()
    whole, solving = [], []
    for i, problem in enumerate(cameras_of(predictions, pose)):
        start = time.perf_counter()
        program = Program(problem, origin[i], unit=1.0)
        written = time.perf_counter()
        program.solve(tolerance=1e-10)
        end = time.perf_counter()
        whole.append(end - start)
        solving.append(end - written)
    return 1e6 * median(whole), 1e6 * median(solving)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_a_batch_is_far_faster_than_one_by_one(device: str, unchecked: None, record: Callable[..., None]) -> None:
    if device == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    n = BATCH[device]
    predictions, pose, _ = random_problems(n, CAMERAS, seed=2)
    predictions = ProjectedHuber(*(column.to(device) for column in columns_of(predictions)))
    pose = Pose(pose.R.to(device), pose.t.to(device))

    def solve() -> object:
        return fuse(predictions, pose)

    solve()  # the first call loads what it needs
    point, processor = microseconds(solve, device, n)
    moments, _ = microseconds(lambda: fuse(predictions, pose).covariance, device, n)
    whole, solving = one_by_one()
    record(
        f"fuse, {n} problems of {CAMERAS} cameras, {device}",
        f"{point:.1f} us a problem ({processor:.1f} of processor time), {moments:.1f} with covariance",
        f"{whole:.0f} us, Clarabel, {solving:.0f} of it set-up and solution",
        f"{whole / point:.0f} and {solving / point:.0f} times",
        str(LEAST_RATIO),
    )
    assert whole / point >= LEAST_RATIO

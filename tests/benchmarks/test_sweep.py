"""The cost of a sweep's job without its training, if one process runs all jobs."""

import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import pytest
from lightning import Trainer

from phd_exp.cli import train

pytestmark = pytest.mark.bench


def timed(function: Callable, seconds: list[float]) -> Callable:
    """The function, whose calls append their seconds."""

    def call(*arguments: Any, **named: Any) -> Any:
        start = time.perf_counter()
        result = function(*arguments, **named)
        seconds.append(time.perf_counter() - start)
        return result

    return call


def test_a_job_after_the_first_costs_two_seconds(
    phd_exp: Callable, unchecked: None, record: Callable, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    fits, jobs = list[float](), list[float]()
    monkeypatch.setattr(Trainer, "fit", timed(Trainer.fit, fits))
    monkeypatch.setattr(train, "task", timed(train.task, jobs))
    assert phd_exp("-m", "preset=smoke", "seed=0,1,2,3,4,5").status == 0
    assert len(jobs) == len(fits) == 6
    own = median(job - fit for job, fit in zip(jobs[1:], fits[1:], strict=True))
    training = f"{median(fits[1:]):.2f} s of training"
    record("a job of a sweep, preset=smoke", f"{own:.2f} s", training, f"{own:.2f} s", "2 s")
    assert own <= 2

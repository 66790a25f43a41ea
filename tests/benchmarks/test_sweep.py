"""What a job of a sweep costs beside its training, where one process runs them all."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from statistics import median

import pytest

pytestmark = pytest.mark.bench
SWEEPER = Path(__file__).with_name("sweeper.py")


def test_a_job_after_the_first_costs_two_seconds(tmp_path: Path, record: Callable) -> None:
    words = [
        "preset=smoke",
        f"data.root={tmp_path / 'renders'}",
        f"runs={tmp_path / 'runs'}",
        "seed=0,1,2,3,4,5",
    ]
    done = subprocess.run([sys.executable, str(SWEEPER), *words], capture_output=True, text=True, check=True)
    _, *jobs = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    assert len(jobs) == 5
    beside = median(job["job"] - job["training"] for job in jobs)
    training = median(job["training"] for job in jobs)
    record(
        "a job of a sweep, preset=smoke",
        f"{beside:.2f} s",
        f"{training:.2f} s of training",
        f"{beside:.2f} s",
        "2 s",
    )
    assert beside <= 2

"""A table of every ratio that was measured, with the machine, at the end of `make bench`."""

import time
from collections.abc import Callable
from statistics import median
from typing import NamedTuple

import pytest
import torch
from jaxtyping import config as jaxtyping_config
from pytest_benchmark.fixture import BenchmarkFixture

from phd_exp.records.processes import machine

ROUNDS = 5


class Row(NamedTuple):
    """One line of the table: what is held against what, each as it is best said, and the figure that counts."""

    what: str
    ours: str
    reference: str
    figure: str
    goal: str


ROWS = pytest.StashKey[list[Row]]()


@pytest.fixture
def record(request: pytest.FixtureRequest) -> Callable[..., None]:
    """Adds a line to the table."""
    rows = request.config.stash.setdefault(ROWS, [])
    return lambda *row: rows.append(Row(*row))


@pytest.fixture
def unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """No shapes of annotations checked in every call, as for users."""
    monkeypatch.setattr(jaxtyping_config, "jaxtyping_disable", True)


@pytest.fixture
def medians(unchecked: None, benchmark: BenchmarkFixture) -> Callable[..., tuple[float, float]]:
    """Median seconds of a task and of its reference, measured in one process one after the other, five times each."""

    def measure(task: Callable[[], object], reference: Callable[[], object]) -> tuple[float, float]:
        benchmark.pedantic(task, rounds=ROUNDS, warmup_rounds=1)
        reference()
        return benchmark.stats.stats.median, median(_seconds(reference) for _ in range(ROUNDS))

    return measure


def _seconds(task: Callable[[], object]) -> float:
    start = time.perf_counter()
    task()
    return time.perf_counter() - start


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    rows = config.stash.get(ROWS, [])
    if not rows:
        return
    terminalreporter.section(f"ratios, medians of {ROUNDS}, on {_machine()}")
    table = [Row("what", "ours", "reference", "figure", "goal"), *rows]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    for row in table:
        terminalreporter.write_line("  ".join(map(str.ljust, row, widths)).rstrip())


def _machine() -> str:
    gpu = f", {torch.cuda.get_device_name()}" if torch.cuda.is_available() else ""
    return f"{machine()}{gpu}, torch {torch.__version__}"

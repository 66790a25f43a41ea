"""The speed of the programme relative to the arithmetic of its network: ratios in one process, medians of five."""

import itertools
import json
import statistics
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

pytestmark = pytest.mark.bench
HERE = Path(__file__).parent
EPOCHS = 6
"""The first one of which warms up."""


def printed(loop: str, folder: Path, epochs: int, *overrides: str) -> str:
    """By a process without the checks of annotations that all tests have."""
    command = [sys.executable, str(HERE / "loops.py"), loop, str(folder), str(epochs), *overrides]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def measured(loop: str, folder: Path, *overrides: str) -> dict[str, list[float]]:
    """The figures of each epoch but the first."""
    lines = printed(loop, folder, EPOCHS, *overrides).splitlines()
    rows = [json.loads(line) for line in lines if line.startswith("{")]
    assert len(rows) == EPOCHS - 1
    return {key: [row[key] for row in rows] for key in rows[0]}


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("resnet18, 112 px", ("backbone=resnet18", "data.image_size=112", "data.batch_size=64", "data.n_train=384")),
        ("resnet50, 224 px", ("backbone=resnet50", "data.image_size=224", "data.batch_size=16", "data.n_train=48")),
    ],
    ids=["resnet18", "resnet50"],
)  # fmt: skip
def test_nothing_but_arithmetic(tmp_path: Path, record: Callable, name: str, overrides: tuple[str, ...]) -> None:
    found = measured("bare", tmp_path, "preset=small", "data.n_test=16", *overrides)
    ratio = statistics.median(mine / its for mine, its in zip(found["programme"], found["bare"], strict=True))
    ours, theirs = (f"{statistics.median(found[key]):.1f} images/s" for key in ("programme", "bare"))
    record(f"programme, {name}", ours, f"{theirs}, bare loop", f"{ratio:.2f} times", "0.97")
    assert ratio >= 0.97


@pytest.mark.parametrize("recipe", ["paper", "strong"])
def test_evaluation_and_logging_are_a_twentieth_of_an_epoch(tmp_path: Path, record: Callable, recipe: str) -> None:
    """Of preset=small, whose training and test samples are as many to one another as here."""
    words = ("preset=small", f"recipe={recipe}", "data.n_train=1600", "data.n_test=250")
    of_epochs = measured("bare", tmp_path, *words)["evaluation"]
    # every other epoch is evaluated
    share = statistics.median(statistics.fmean(pair) for pair in itertools.pairwise(of_epochs))
    record(f"evaluation, recipe={recipe}", f"{100 * share:.1f} %", "an epoch", f"{100 * share:.1f} %", "5 %")
    assert share <= 0.05


def test_all_samples_of_the_paper_take_two_gibibytes(tmp_path: Path, record: Callable) -> None:
    """In addition to the memory of the network and one batch."""

    def peak(loop: str, *overrides: str) -> float:
        return int(printed(loop, tmp_path, 0, "preset=paper", *overrides)) / 2**30

    bare, programme = peak("bare", "data.n_train=64", "data.n_test=1"), peak("programme")
    more = programme - bare
    beside = f"{bare:.1f} GiB, bare loop"
    record("peak memory, preset=paper", f"{programme:.1f} GiB", beside, f"+{more:.2f} GiB", "2 GiB")
    assert more <= 2

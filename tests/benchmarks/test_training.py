"""How near the whole programme comes to the arithmetic of its network; ratios within one process, medians of five."""

import json
import statistics
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.bench
HERE = Path(__file__).parent
EPOCHS = 6
"""The first one of which warms up."""


def measured(folder: Path, *overrides: str) -> dict[str, list[float]]:
    """In a process without the checks of annotations that all tests have."""
    done = subprocess.run(
        [sys.executable, str(HERE / "trainer.py"), str(folder), str(EPOCHS), *overrides],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    rows = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
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
def test_nothing_but_arithmetic(tmp_path: Path, name: str, overrides: tuple[str, ...]) -> None:
    found = measured(tmp_path, "preset=small", "data.n_test=16", *overrides)
    ratios = [mine / bare for mine, bare in zip(found["programme"], found["bare"], strict=True)]
    speeds = {key: round(statistics.median(found[key]), 1) for key in ("programme", "bare")}
    print(
        f"{name}: {speeds['programme']} images/s, bare loop {speeds['bare']}, ratio {statistics.median(ratios):.3f}"
    )
    assert statistics.median(ratios) >= 0.97


@pytest.mark.parametrize("recipe", ["paper", "strong"])
def test_evaluation_and_logging_are_a_twentieth_of_an_epoch(tmp_path: Path, recipe: str) -> None:
    """Of preset=small, whose training and test samples are as many to one another as here."""
    found = measured(tmp_path, "preset=small", f"recipe={recipe}", "data.n_train=1600", "data.n_test=250")
    share = statistics.median(found["evaluation"])
    print(f"recipe={recipe}: evaluation and logging take {100 * share:.1f} % of an epoch")
    assert share <= 0.05

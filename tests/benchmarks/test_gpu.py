"""The script of `make gpu`, rehearsed on the CPU at the size of a smoke test."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
SCRIPT = Path(__file__).parent / "gpu.py"
SMALL = ("data.batch_size=8", "data.image_size=64", "trainer.accelerator=cpu")
RUN = ("preset=smoke", "data.n_train=16", "data.n_held_out=4", "trainer.max_epochs=1", *SMALL)


def printed(*words: str) -> list[dict]:
    command = [sys.executable, str(SCRIPT), *words]
    finished = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return [json.loads(line) for line in finished.stdout.splitlines()]


def test_images_per_second_of_each_recipe() -> None:
    _, *rows = printed("--recipes", "paper", "strong, robust", "--steps", "2", *SMALL)
    assert [row["recipe"] for row in rows] == ["paper", "strong, robust"]
    assert all(row["images_per_s"] > 0 and row["wait"] < 1 for row in rows)


def test_whole_runs_end_with_their_results(tmp_path: Path) -> None:
    folders = ("--folder", str(tmp_path / "runs"), f"data.root={tmp_path}")
    _, *rows = printed("--runs", "protocol", "record", *folders, *RUN)
    assert [row["run"] for row in rows] == ["protocol", "record"]
    assert all(row["seconds"] > 0 and row["held_out/nll"] < 20 for row in rows)

"""The script of `make gpu`, rehearsed on the CPU at the size of a smoke test."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
SCRIPT = Path(__file__).parent / "gpu.py"
SMALL = ("data.batch_size=8", "data.image_size=64", "trainer.accelerator=cpu")


def test_images_per_second_of_each_recipe() -> None:
    command = [sys.executable, str(SCRIPT), "--recipes", "paper", "strong, robust", "--steps", "2", *SMALL]
    finished = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    _, *rows = [json.loads(line) for line in finished.stdout.splitlines()]
    assert [row["recipe"] for row in rows] == ["paper", "strong, robust"]
    assert all(row["images_per_s"] > 0 and row["wait"] < 1 for row in rows)

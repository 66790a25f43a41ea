"""One process renders 500 images and trains 200 runs, one render worker makes 500: neither grows, nothing is left.

The first took 30 minutes on two cores that four times as many processes used; SOAK_SHARE=0.2 in the environment asks
for a fifth of both. `pytest -s` shows the figures.
"""

import json
import multiprocessing
import os
import subprocess
import sys
import uuid
from collections.abc import Callable
from pathlib import Path

import pytest

from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.render import render_all
from phd_exp.rendering.sealing import begin
from tests.e2e.conftest import QUICK
from tests.soak.soaker import memory

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(3600),
    pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="looks at processes through /proc"),
]

SHARE = float(os.environ.get("SOAK_SHARE", "1"))
ROUNDS = max(1, round(20 * SHARE))
IMAGES = max(50, round(500 * SHARE))
SOAKER = Path(__file__).with_name("soaker.py")
MOST_GROWTH = 1.2


def test_a_process_that_trains_and_renders_for_long_neither_grows_nor_leaves_anything(tmp_path: Path) -> None:
    folders = {name: tmp_path / name.lower() for name in ("WORK", "HOME", "TMPDIR")}
    for folder in folders.values():
        folder.mkdir()
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("WANDB_", "XDG_"))}
    environment |= {name: str(folder) for name, folder in folders.items() if name != "WORK"}
    environment |= {"SOAK": uuid.uuid4().hex, "PYTHONPATH": str(Path(__file__).parents[2])}
    command = [sys.executable, str(SOAKER), str(ROUNDS), *QUICK]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folders["WORK"], env=environment, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    before, after = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    print(f"\n{ROUNDS} rounds\nbefore {before}\nafter  {after}")
    assert after.pop("memory") < MOST_GROWTH * before.pop("memory")
    assert after == before


def test_a_render_worker_does_not_grow(tmp_path: Path, make_spec: Callable[..., DatasetSpec]) -> None:
    spec = make_spec("occl_scale", sensor_size=64, f_range=(343.0, 571.0))
    folder = DatasetFolder(tmp_path / "occl_scale")
    folder.cache.mkdir(parents=True)
    begin(folder, spec)
    samples, kilobytes, handles = [("train", index) for index in range(IMAGES)], [], []
    for number, _ in enumerate(render_all(folder, spec, samples, workers=1)):
        if number in (IMAGES // 10, IMAGES - 3):  # the last ones are finished at once
            (worker,) = multiprocessing.active_children()
            kilobytes.append(memory(worker.pid))
            handles.append(len(os.listdir(f"/proc/{worker.pid}/fd")))
    print(f"\n{IMAGES} images: {kilobytes} kB, {handles} handles")
    assert kilobytes[1] < MOST_GROWTH * kilobytes[0]
    assert handles[1] == handles[0]

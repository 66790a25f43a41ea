"""How good our pictures are, held against converged ones, and how fast they come.

`make bench` prints the tables. References take minutes the first time and are kept in `.bench/`. BENCH_SEED and
BENCH_IMAGES choose other samples, and how many of each variant.
"""

import hashlib
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import mean, median

import numpy as np
import pytest
from PIL import Image

from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.render import render_all, worker_count
from phd_exp.rendering.sampling import GENERATOR_VERSION
from phd_exp.rendering.sealing import begin

pytestmark = [pytest.mark.bench, pytest.mark.timeout(7200)]

ROOT = Path(__file__).parents[2]
SEED = int(os.environ.get("BENCH_SEED", "2026"))  # not the seed that settings were chosen on
IMAGES = int(os.environ.get("BENCH_IMAGES", "8"))  # of each variant
ROUNDS = 3
BURST = 60  # images a round
LEAST_RATIO = {"default": 8, "scale": 8, "occl": 4, "occl_scale": 4}


@pytest.fixture(params=LEAST_RATIO)
def spec(request: pytest.FixtureRequest, make_spec: Callable[..., DatasetSpec]) -> DatasetSpec:
    return make_spec(request.param, seed=SEED)


def painted(kind: str, spec: DatasetSpec, folder: Path, indices: Sequence[int]) -> list[float]:
    """Paint images into the folder; returns the seconds of each."""
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, str(Path(__file__).with_name("painter.py")), kind, spec.model_dump_json(), str(folder)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    result = subprocess.run([*command, *map(str, indices)], env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return [json.loads(line)["seconds"] for line in result.stdout.splitlines() if line.startswith("{")]


def references(spec: DatasetSpec) -> Path:
    """The folder of converged pictures of the first samples; those of an earlier call are kept."""
    looks = spec.model_dump_json(exclude={"samples_per_pixel", "image_format", "image_quality"})
    key = hashlib.sha256(f"{GENERATOR_VERSION} {looks}".encode()).hexdigest()[:12]
    folder = ROOT / ".bench" / f"{spec.variant}-{key}"
    missing = [index for index in range(IMAGES) if not (folder / f"{index}.png").exists()]
    cores = os.cpu_count() or 1
    with ThreadPoolExecutor(cores) as pool:
        shares = [missing[core::cores] for core in range(cores)]
        list(pool.map(lambda share: painted("reference", spec, folder, share) if share else None, shares))
    return folder


def quality(folder: Path, against: Path) -> list[float]:
    """PSNR of each image, dB."""
    return [psnr(folder / f"{index}.png", against / f"{index}.png") for index in range(IMAGES)]


def psnr(path: Path, reference: Path) -> float:
    one, other = (np.asarray(Image.open(file).convert("RGB")).astype(float) for file in (path, reference))
    return 10 * math.log10(255**2 / max(float(((one - other) ** 2).mean()), 1e-9))


def our_images_a_second(spec: DatasetSpec, folder: DatasetFolder) -> float:
    """Of the whole machine, as `render` uses it, once the workers have begun."""
    n = BURST
    folder.cache.mkdir(parents=True, exist_ok=True)
    begin(folder, spec)
    tasks = [("test", index) for index in range(n)]
    times = [time.perf_counter() for _ in render_all(folder, spec, tasks, worker_count(n))]
    return (n - 1) / (times[-1] - times[0])


def test_good_and_fast(spec: DatasetSpec, tmp_path: Path, record: Callable[..., None]) -> None:
    painted("ours", spec, tmp_path / "ours", range(IMAGES))
    values = quality(tmp_path / "ours", references(spec))
    speed = median(our_images_a_second(spec, DatasetFolder(tmp_path / f"burst-{turn}")) for turn in range(ROUNDS))
    converged = median(painted("reference", spec, tmp_path / "converged", range(3))[1:])  # the first one compiles
    record(
        f"render data={spec.variant}, {IMAGES} images, seed {SEED}",
        f"{speed:.1f} images/s, PSNR {mean(values):.1f} dB mean, {min(values):.1f} worst",
        f"{1 / converged:.2f} images/s, converged",
        f"{speed * converged:.0f} times",
        str(LEAST_RATIO[spec.variant]),
    )
    assert mean(values) >= 41
    assert min(values) >= 38
    assert speed * converged >= LEAST_RATIO[spec.variant]

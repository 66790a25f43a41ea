"""How good our pictures are, and how fast they come, beside the conventional way at the same quality.

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
BURST = {"ours": 60, "conventional": 12}  # images a round
SAMPLES = [round(2 ** (step / 4)) for step in range(8, 30)]  # that the conventional way is raised through
LEAST_RATIO = {"default": 8, "scale": 8, "occl": 4, "occl_scale": 4}


@pytest.fixture(params=LEAST_RATIO)
def spec(request: pytest.FixtureRequest, make_spec: Callable[..., DatasetSpec]) -> DatasetSpec:
    return make_spec(request.param, seed=SEED)


def painted(kind: str, spec: DatasetSpec, folder: Path, samples: int, indices: Sequence[int]) -> list[float]:
    """Seconds an image; the images lie in the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, str(Path(__file__).with_name("painter.py")), kind, spec.model_dump_json()]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    result = subprocess.run(
        [*command, str(folder), str(samples), *map(str, indices)],
        env=environment, capture_output=True, text=True,
    )  # fmt: skip
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
        list(pool.map(lambda share: painted("reference", spec, folder, 0, share) if share else None, shares))
    return folder


def quality(folder: Path, against: Path) -> list[float]:
    """PSNR of each image, dB."""
    return [psnr(folder / f"{index}.png", against / f"{index}.png") for index in range(IMAGES)]


def psnr(path: Path, reference: Path) -> float:
    one, other = (np.asarray(Image.open(file).convert("RGB")).astype(float) for file in (path, reference))
    return 10 * math.log10(255**2 / max(float(((one - other) ** 2).mean()), 1e-9))


def our_images_a_second(spec: DatasetSpec, folder: DatasetFolder) -> float:
    """Of the whole machine, as `render` uses it, once the workers have begun."""
    n = BURST["ours"]
    folder.cache.mkdir(parents=True, exist_ok=True)
    begin(folder, spec)
    tasks = [("test", index) for index in range(n)]
    times = [time.perf_counter() for _ in render_all(folder, spec, tasks, worker_count(n))]
    return (n - 1) / (times[-1] - times[0])


def conventional_images_a_second(spec: DatasetSpec, folder: Path, samples: int) -> float:
    """The same; the first image is left out, which compiles what later ones find compiled."""
    return 1 / median(painted("conventional", spec, folder, samples, range(BURST["conventional"]))[1:])


def samples_for(spec: DatasetSpec, folder: Path, target: float, against: Path) -> tuple[int, float]:
    """The fewest samples a pixel at which the conventional way is as good on average, and how good it is then."""
    low, high = 0, len(SAMPLES) - 1
    found = (SAMPLES[-1], 0.0)
    while low <= high:
        middle = (low + high) // 2
        painted("conventional", spec, folder, SAMPLES[middle], range(IMAGES))
        reached = mean(quality(folder, against))
        if reached >= target:
            found, high = (SAMPLES[middle], reached), middle - 1
        else:
            low = middle + 1
    assert found[1] >= target, f"{SAMPLES[-1]} samples a pixel are not enough for {target:.1f} dB"
    return found


def test_as_good_and_faster(spec: DatasetSpec, tmp_path: Path, record: Callable[..., None]) -> None:
    against = references(spec)
    painted("ours", spec, tmp_path / "ours", 0, range(IMAGES))
    values = quality(tmp_path / "ours", against)
    samples, reached = samples_for(spec, tmp_path / "conventional", mean(values), against)
    rates = [
        (
            our_images_a_second(spec, DatasetFolder(tmp_path / f"burst-{turn}")),
            conventional_images_a_second(spec, tmp_path / "conventional", samples),
        )
        for turn in range(ROUNDS)
    ]
    ratio = median(fast / slow for fast, slow in rates)
    ours, theirs = (median(speeds) for speeds in zip(*rates, strict=True))
    record(
        f"render data={spec.variant}, {IMAGES} images, seed {SEED}",
        f"{ours:.1f} images/s, PSNR {mean(values):.1f} dB mean, {min(values):.1f} worst",
        f"{theirs:.2f} images/s, conventional, {samples} samples a pixel, {reached:.1f} dB",
        f"{ratio:.1f} times",
        str(LEAST_RATIO[spec.variant]),
    )
    assert mean(values) >= 41
    assert min(values) >= 38
    assert ratio >= LEAST_RATIO[spec.variant]

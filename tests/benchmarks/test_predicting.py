"""How many photographs `predict` answers in a second of one core, beyond its start."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import pytest
from PIL import Image

from phd_exp.hardware import one_thread
from phd_exp.inference.answers import answer, sightings
from phd_exp.inference.loading import load
from phd_exp.records.own_images import detections_in
from tests.support.untrained import untrained

pytestmark = pytest.mark.bench
N, ROUNDS = 128, 5
CAMERA = {
    "image_width": 640,
    "image_height": 480,
    "camera_matrix": {"rows": 3, "cols": 3, "data": [530, 0, 320, 0, 530, 240, 0, 0, 1]},
    "distortion_model": "plumb_bob",
    "distortion_coefficients": {"rows": 1, "cols": 5, "data": [-0.28, 0.03, 0.001, 0, 0.16]},
}


def write_photographs(folder: Path) -> None:
    """Photographs of 640 x 480 pixels by a camera with a lens; half of their boxes shrink, half enlarge."""
    draw, lines = np.random.default_rng(0), []
    folder.mkdir()
    (folder / "camera.yaml").write_text(json.dumps(CAMERA))
    for index in range(N):
        coarse = draw.integers(0, 256, (15, 20, 3), dtype=np.uint8)
        Image.fromarray(coarse).resize((640, 480), Image.Resampling.BICUBIC).save(folder / f"{index}.jpg")
        half = (150, 80)[index % 2]
        box = [320 - half, 240 - half, 320 + half, 240 + half]
        lines.append(json.dumps({"file_name": f"{index}.jpg", "camera": "camera.yaml", "box": box}) + "\n")
    (folder / "metadata.jsonl").write_text("".join(lines))


def test_predictions_of_photographs_on_one_core(
    unchecked: None, composed: Callable[..., Any], record: Callable, tmp_path: Path
) -> None:
    write_photographs(tmp_path / "photos")
    run = untrained(tmp_path / "run", composed("preset=small", "recipe=strong", "data=default"))
    predictor, detections = load(run.path, "cpu"), detections_in(tmp_path / "photos")
    seconds = []
    with one_thread():
        for _ in range(ROUNDS):
            start = time.process_time()
            lines = [json.dumps(answer(one, predictor.temperature)) for one in sightings(predictor, detections)]
            seconds.append(time.process_time() - start)
    assert len(lines) == N
    speed = N / median(seconds)
    record("predict, boxes with a lens", f"{speed:.0f} images/s", "one core", f"{speed:.0f}", "100")
    assert speed >= 100

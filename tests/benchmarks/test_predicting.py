"""How many images `predict` and exported graphs answer in a second of one core, beyond their start."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from phd_exp.hardware import one_thread
from phd_exp.inference.answers import sightings
from phd_exp.inference.following import follow
from phd_exp.inference.frames import of_video
from phd_exp.inference.loading import load
from phd_exp.records.detections import detections_of
from phd_exp.records.own_images import detections_in
from phd_exp.records.videos import VideoWriter
from tests.support.untrained import untrained

pytestmark = [pytest.mark.bench, pytest.mark.timeout(1800)]
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
            lines = [json.dumps(one.line) for one in sightings(predictor, detections)]
            seconds.append(time.process_time() - start)
    assert len(lines) == N
    speed = N / median(seconds)
    record("predict, boxes with a lens", f"{speed:.0f} images/s", "one core", f"{speed:.0f}", "100")
    assert speed >= 100


@pytest.mark.parametrize(("width", "height"), [(640, 480), (1280, 960)], ids=str)
def test_frames_of_a_video_on_one_core(
    unchecked: None, composed: Callable[..., Any], record: Callable, tmp_path: Path, width: int, height: int
) -> None:
    """A box of each frame is predicted, since an untrained network cannot follow one."""
    pytest.importorskip("av", reason="needs `pip install 'phd_exp[video]'`")
    coarse = np.random.default_rng(0).integers(0, 256, (15, 20, 3), dtype=np.uint8)
    image = np.asarray(Image.fromarray(coarse).resize((width, height), Image.Resampling.BICUBIC))
    with VideoWriter(tmp_path / "clip.mp4", (width, height)) as video:
        for n in range(N):
            video.add(n / 30, np.roll(image, n, axis=1))
    scale = width / 640
    K = [530 * scale, 0, width / 2, 0, 530 * scale, height / 2, 0, 0, 1]
    matrix = {"rows": 3, "cols": 3, "data": K}
    camera = CAMERA | {"image_width": width, "image_height": height, "camera_matrix": matrix}
    (tmp_path / "camera.yaml").write_text(json.dumps(camera))
    (detection,) = detections_of([tmp_path / "clip.mp4"], {"camera": str(tmp_path / "camera.yaml")})
    boxes = {n: [tuple(scale * (one + n / 4) for one in (170, 90, 410, 330))] for n in range(N)}
    run = untrained(tmp_path / "run", composed("preset=small", "recipe=strong", "data=default"))
    predictor, seconds = load(run.path, "cpu"), []
    with one_thread():
        for _ in range(ROUNDS):
            start = time.process_time()
            followed = follow(predictor, of_video(tmp_path / "clip.mp4", detection, boxes))
            lines = [json.dumps(one.answer(predictor)) for one in followed]
            seconds.append(time.process_time() - start)
    assert len(lines) == N
    speed = N / median(seconds)
    record(f"track, {width} x {height} pixels with a lens", f"{speed:.0f} frames/s", "one core", f"{speed:.0f}", "30")
    assert speed >= 30


def test_exported_graphs_on_one_core(
    unchecked: None, composed: Callable[..., Any], record: Callable, tmp_path: Path
) -> None:
    onnxruntime = pytest.importorskip("onnxruntime", reason="needs `pip install 'phd_exp[export]'`")
    from phd_exp.inference.deployed import OfImages, pictures
    from phd_exp.inference.onnx import graph

    run = untrained(tmp_path / "run", composed("preset=small", "recipe=strong", "data=default"))
    predictor = load(run.path, "cpu")
    image, f = torch.from_numpy(pictures(N, predictor.side, predictor.side)), torch.full((N,), 1550.0)
    deployed = {name: OfImages(predictor, name).eval() for name in ("float32", "float64")}
    graphs = {name: graph(one) for name, one in deployed.items()}
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    sessions = {name: onnxruntime.InferenceSession(one.SerializeToString(), options) for name, one in graphs.items()}
    given = {"image": image[:32].numpy(), "f": f[:32].numpy()}
    seconds: dict[str, list[float]] = {name: [] for name in sessions}
    for _ in range(ROUNDS + 1):  # in turn, since other work changes the speed; the first round warms up
        for name, session in sessions.items():
            start = time.process_time()
            session.run(None, given)
            seconds[name].append(time.process_time() - start)
    speed = {name: 32 / median(one[1:]) for name, one in seconds.items()}
    for name, value in speed.items():
        ratio = value / speed["float64"]
        record(f"exported graph, {name}", f"{value:.0f} images/s", "float64", f"{ratio:.2f}", "0.9")
    assert speed["float32"] > 0.9 * speed["float64"]

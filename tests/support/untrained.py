"""Runs as `predict` reads them, without a training: a configuration and a network of random weights."""

import json
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from phd_exp.build import build_regressor
from phd_exp.config import check
from phd_exp.data.images import SHRINKING
from phd_exp.geometry import DepthScale, VirtualCamera, intrinsics
from phd_exp.records.runs import RunFolder

SIDE = 48
LOCATING = "backbone._target_=phd_exp.models.locating.Locating"
NARROW = (
    LOCATING, "+backbone.width=8", "+backbone.stride=4", "+backbone.channels=4", "+backbone.points=2",
    "recipe.hidden=8",
)  # fmt: skip
"""A network of less than a megabyte. That of `preset=smoke` has 20, and 60 where a training is resumed."""
SMALL = ("preset=smoke", *NARROW, f"data.image_size={SIDE}", "trainer.threads=1")
NOWHERE = ("data=folder", "data.folder=nowhere")
DEPTH = DepthScale.from_ranges(f_range=(200.0, 300.0), z_range=(2.0, 5.0))


def untrained(path: Path, config: dict[str, Any]) -> RunFolder:
    """The record of a finished run whose last layer has random weights."""
    folder = RunFolder(path)
    torch.manual_seed(0)
    regressor = build_regressor(check(config), DEPTH)
    torch.nn.init.normal_(regressor.last.weight, std=0.3)
    folder.checkpoints.mkdir(parents=True)
    with folder.recording(None):
        folder.write_config(config)
        folder.write_constants(asdict(DEPTH) | {"constant_f": 250.0, "shrinking": SHRINKING})
        weights = {f"regressor.{name}": value for name, value in regressor.state_dict().items()}
        torch.save({"state_dict": weights}, folder.last_checkpoint)
    return folder


def write_photos(folder: Path, n: int) -> None:
    """Noise of two sizes with boxes anywhere, and the position of an object in each."""
    draw = np.random.default_rng(0)
    folder.mkdir()
    lines = []
    for index in range(n):
        width, height = (120, 90) if index % 2 else (90, 120)
        noise = draw.integers(0, 256, (height, width, 3), dtype=np.uint8)
        Image.fromarray(noise).save(folder / f"{index}.png")
        camera = {"fx": 300.0, "fy": 310.0, "cx": 50.0, "cy": 40.0, "box": [5 + index, 10, 60, 70 + index]}
        position = {"x": 0.01 * index, "y": -0.02, "z": 3.0 + 0.1 * index}
        lines.append({"file_name": f"{index}.png"} | camera | position)
    write_metadata(folder, lines)


def virtual_cameras(photos: Path, side: int = SIDE) -> Iterator[VirtualCamera]:
    """The cameras of the boxes that a folder's metadata.jsonl has."""
    for line in read_metadata(photos):
        fx, fy = line.get("fx", line.get("f")), line.get("fy", line.get("f"))
        with Image.open(photos / line["file_name"]) as image:
            K = intrinsics(fx, fy, line.get("cx", image.width / 2), line.get("cy", image.height / 2))
        yield VirtualCamera.of_box(K, tuple(map(float, line["box"])), float(side))  # type: ignore[arg-type]


def read_metadata(folder: Path) -> list[dict[str, Any]]:
    """The lines of `metadata.jsonl` in a folder."""
    return read_lines((folder / "metadata.jsonl").read_text())


def write_metadata(folder: Path, lines: Iterable[dict[str, Any]]) -> None:
    """Write `metadata.jsonl` in a folder."""
    (folder / "metadata.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


def read_lines(text: str) -> list[dict[str, Any]]:
    """JSON lines."""
    return [json.loads(line) for line in text.splitlines()]

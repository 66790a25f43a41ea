"""What the goldens are made of: fixed photographs, and networks of fixed weights."""

import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import pytest
import torch
from PIL import Image

from tests.golden.compare import PLACE, TOLERANCES, compared, read, write
from tests.support.untrained import SIDE, read_lines, untrained, write_metadata

WIDTH, HEIGHT, F, RADIUS = 160, 120, 500.0, 0.3


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--write-golden", action="store_true", help="write what was found as the new goldens")


@pytest.fixture
def golden(request: pytest.FixtureRequest, tmp_path: Path) -> Callable[..., None]:
    """Require that files, by name, hold what a golden's folder holds; or write them there."""

    def require(name: str, made: dict[str, Any]) -> None:
        place, found, tolerances = PLACE / name, tmp_path / "found", TOLERANCES[name.split("/")[0]]
        for file, value in made.items():
            write(found / file, value)
        now, old = ({p.name: read(p) for p in sorted(folder.glob("*.*"))} for folder in (found, place))
        values, differences = compared(now, old, tolerances)
        if request.config.getoption("--write-golden", default=False):
            shutil.rmtree(place, ignore_errors=True)
            for file, value in values.items():
                write(place / file, value)
        else:
            assert differences[:20] == []

    return require


def lines(outcome: Any) -> list[dict[str, Any]]:
    """The printed JSON lines of a command."""
    assert outcome.status == 0, outcome.err
    return read_lines(outcome.out)


def photograph(folder: Path, lines: Iterable[dict[str, Any]], size: tuple[int, int] = (WIDTH, HEIGHT)) -> Path:
    """Write a picture for each line, of a ball at its x, y, z before a pattern, and the metadata.jsonl."""
    folder.mkdir(parents=True)
    column, row = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    written = []
    for number, line in enumerate(lines):
        u, v, radius = _seen(line, size)
        inside = (column - u) ** 2 + (row - v) ** 2 < radius**2
        ground = (3 * column * (number % 5 + 1) + 5 * row).astype(int) % 97 + 40
        shade = np.stack([200 - ground, ground + 60, ground // 2 + 90 - 7 * (number % 4)], -1)
        picture = np.where(inside[..., None], (220 - number, 60 + 3 * number, 50), shade).astype(np.uint8)
        Image.fromarray(picture).save(folder / f"{number:02d}.png")
        written.append({"file_name": f"{number:02d}.png"} | line)
    write_metadata(folder, written)
    return folder


def _seen(line: dict[str, Any], size: tuple[int, int]) -> tuple[float, float, float]:
    """Column, row and radius of the ball, pixels."""
    scale = line.get("f", F) / line["z"]
    return scale * line["x"] + size[0] / 2, scale * line["y"] + size[1] / 2, scale * RADIUS


def boxed(line: dict[str, Any]) -> dict[str, Any]:
    """The line with a box of 1.2 times the ball."""
    u, v, radius = _seen(line, (WIDTH, HEIGHT))
    return line | {"box": [u - 1.2 * radius, v - 1.2 * radius, u + 1.2 * radius, v + 1.2 * radius]}


def placed(number: int, f: float = F, across: float = 0.2) -> dict[str, Any]:
    """A position for each number, between 3 and 4 m."""
    turn = 2.4 * number
    x, y = across * np.cos(turn), across * 0.5 * np.sin(turn)
    return {"f": f, "x": float(x), "y": float(y), "z": 3.5 + 0.5 * float(np.sin(1.7 * number))}


@pytest.fixture
def network(composed: Callable[..., dict[str, Any]], tmp_path: Path) -> Callable[..., Path]:
    """The folder of a run whose weights are drawn by NumPy, for each from its name: equal on every machine."""

    def made(name: str, *words: str) -> Path:
        words = ("preset=smoke", "data=folder", "data.folder=nowhere", f"data.image_size={SIDE}", *words)
        folder = untrained(tmp_path / "networks" / name, composed(*words, "trainer.threads=1"))
        state = torch.load(folder.last_checkpoint, weights_only=True)["state_dict"]
        for key, old in state.items():
            draw = np.random.default_rng(crc32(f"{name} {key}".encode())).uniform(-1, 1, tuple(old.shape))
            # variance 1 / inputs of matrices and filters; around 1 for norms
            spread, centre = ((3 / draw[0].size) ** 0.5, 0) if old.ndim > 1 else (0.2, key.endswith("weight"))
            if key.endswith(("weight", "bias")):
                state[key] = torch.from_numpy(centre + spread * draw).float()
        torch.save({"state_dict": state}, folder.last_checkpoint)
        return folder.path

    return made

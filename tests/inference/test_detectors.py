"""Detectors: functions of the user, whatever they return."""

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from phd_exp.records.runs import RunFolder
from tests.inference.test_track import frames
from tests.support.untrained import NOWHERE, read_lines

WIDTH, HEIGHT = 120, 90
BOXES = np.array([[10.0, 5.0, 60.0, 70.0], [30.0, 20.0, 130.0, 85.0]])  # the second reaches beyond the image
SCORES = np.array([0.25, 0.75])
CLASSES = np.array([3, 8])


@pytest.fixture(scope="module")
def run(make: Callable[..., RunFolder]) -> RunFolder:
    return make(*NOWHERE)


@pytest.fixture
def detector(monkeypatch: pytest.MonkeyPatch) -> Callable[[Any], str]:
    """The word that names a function."""

    def named(function: Any) -> str:
        module = ModuleType("somebodys")
        module.find = function  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, "somebodys", module)
        return "boxes=somebodys:find"

    return named


@pytest.fixture
def photos(tmp_path: Path) -> list[str]:
    """The words of a folder of two photographs."""
    folder = tmp_path / "photos"
    folder.mkdir()
    for name in "ab":
        noise = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        Image.fromarray(noise).save(folder / f"{name}.png")
    return [f"folder={folder}", "f=300"]


def test_a_function_is_as_good_as_its_boxes_in_a_file(
    phd_exp: Callable, run: RunFolder, detector: Callable, photos: list[str], tmp_path: Path
) -> None:
    word = detector(lambda image: (torch.from_numpy(BOXES), torch.from_numpy(SCORES), CLASSES))
    outcome = phd_exp("predict", f"run={run.path}", *photos, word)
    assert (outcome.status, outcome.err) == (0, "")
    results = [
        {"bbox": [*box[:2], *(box[2:] - box[:2])], "score": score, "category_id": int(category)}
        for box, score, category in zip(BOXES, SCORES, CLASSES, strict=True)
    ]
    (tmp_path / "boxes.json").write_text(json.dumps(results[::-1]))  # the most certain first
    image = f"image={tmp_path / 'photos/a.png'}"
    same = phd_exp("predict", f"run={run.path}", image, "f=300", f"boxes={tmp_path / 'boxes.json'}")
    for line, other in zip(read_lines(outcome.out)[:2], read_lines(same.out), strict=True):
        assert [line[key] for key in ("box", "score", "category_id")] == [
            other[key] for key in ("box", "score", "category_id")
        ]
        assert line["mean"] == pytest.approx(other["mean"], rel=1e-5)  # float32, in batches of four and two
    assert [line["file_name"] for line in read_lines(outcome.out)] == ["a.png", "a.png", "b.png", "b.png"]
    one = phd_exp("predict", f"run={run.path}", *photos, word, "object=8")
    assert [line["box"] for line in read_lines(one.out)] == [BOXES[1].tolist()] * 2


@pytest.mark.parametrize(
    ("returned", "said"),
    [
        (None, "got NoneType"),
        ((BOXES, SCORES), "got tuple"),
        ((BOXES[0], SCORES[:1], CLASSES[:1]), r"got shapes ((4,), (1,), (1,)); expected boxes, scores and classes"),
        ((BOXES, SCORES[:1], CLASSES), "got shapes ((2, 4), (1,), (2,))"),
        (([[1, 2, 3, 4], [1]], SCORES, CLASSES), "got tuple (ValueError"),
        ((BOXES * np.nan, SCORES, CLASSES), "box.0: got nan; expected to be a finite number"),
        ((BOXES + 200, SCORES, CLASSES), "lies outside the image of 120 x 90 pixels"),
        ((BOXES, [None, None], CLASSES), "score: got None; expected a number"),
        ((BOXES, SCORES, CLASSES + 0.5), "category_id: got 3.5; expected a whole number or a name"),
        (([], [], []), "finds nothing; expected a box in at least one image"),
        (KeyError("boom"), "raised KeyError: 'boom' ("),
    ],
)
def test_nonsense_of_a_function_is_refused_on_one_line(
    phd_exp: Callable, run: RunFolder, detector: Callable, photos: list[str], returned: Any, said: str
) -> None:
    def find(image: np.ndarray) -> Any:
        image[:] = 0  # its own copy
        if isinstance(returned, Exception):
            raise returned
        return returned

    outcome = phd_exp("predict", f"run={run.path}", *photos, detector(find))
    assert (outcome.status, outcome.out) == (1, "")
    (line,) = outcome.err.splitlines()
    assert re.search(r"a\.png.*: boxes=somebodys:find", line)
    assert said in line


def test_an_image_in_which_nothing_is_found_has_no_line(
    phd_exp: Callable, run: RunFolder, detector: Callable, photos: list[str]
) -> None:
    calls = []

    def find(image: np.ndarray) -> Any:
        calls.append(image)
        return (BOXES, SCORES, ["cup", "cat"]) if len(calls) == 2 else ([], [], [])

    outcome = phd_exp("predict", f"run={run.path}", *photos, detector(find))
    assert [(line["file_name"], line["category_id"]) for line in read_lines(outcome.out)] == [
        ("b.png", "cat"),
        ("b.png", "cup"),
    ]
    assert outcome.err.startswith("note: boxes=somebodys:find finds nothing in 1 image(s): ")


@pytest.mark.parametrize(
    ("words", "said"), [(("boxes=somebodys:other",), "boxes=somebodys:other: 'somebodys.other' cannot be imported")]
)
def test_wrong_arguments_are_refused(
    phd_exp: Callable, run: RunFolder, detector: Callable, photos: list[str], words: tuple[str, ...], said: str
) -> None:
    detector(lambda image: (BOXES, SCORES, CLASSES))
    outcome = phd_exp("predict", f"run={run.path}", *photos, *words)
    assert outcome.status == 2
    (line,) = outcome.err.splitlines()
    assert said in line


def test_a_path_asks_a_detector_only_where_it_knows_no_box(
    phd_exp: Callable, run: RunFolder, detector: Callable, tmp_path: Path
) -> None:
    calls = []

    def find(image: np.ndarray) -> Any:
        calls.append(image)
        return ([[8.0, 12.0, 32.0, 38.0]], [1.0], [0]) if len(calls) > 2 else ([], [], [])

    outcome = phd_exp("track", f"run={run.path}", frames(tmp_path), detector(find))
    assert (outcome.status, outcome.err) == (0, "")
    lines = read_lines(outcome.out)
    assert [line["state"] for line in lines[:2]] == ["lost", "lost"]
    assert lines[2]["box"] == [8, 12, 32, 38]
    assert all(line["state"] != "lost" and "box" in line for line in lines[2:])
    assert 3 <= len(calls) < len(lines)

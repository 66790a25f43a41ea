"""Views and predictions beyond a run's training: warnings in every line, and views that are refused."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from PIL import Image

import phd_exp as package
from phd_exp.geometry import VirtualCamera, intrinsics
from phd_exp.inference.ranges import ANY, Ranges
from phd_exp.records.runs import RunFolder
from tests.inference.test_track import frames
from tests.support.untrained import SIDE, read_lines, write_metadata

PIXELS = 200
LEAST, LARGEST = (f / 224 * PIXELS for f in (1200, 2000))
"""The focal lengths of the training on `default`, px of an image of `PIXELS`."""
HERE = {"rotation": [1, 0, 0, 0], "translation": [0, 0, 0]}


@pytest.fixture(scope="module")
def run(make: Callable[..., RunFolder]) -> str:
    return f"run={make('data=default').path}"


def photos(folder: Path, focal_lengths: list[float], **more: Any) -> Path:
    """A folder with a grey photograph for each focal length."""
    folder.mkdir()
    lines = [{"file_name": f"{k}.png", "f": f} | more for k, f in enumerate(focal_lengths)]
    for line in lines:
        Image.new("RGB", (PIXELS, PIXELS), (90, 90, 90)).save(folder / line["file_name"])
    write_metadata(folder, lines)
    return folder


def kinds(line: dict[str, Any]) -> set[str]:
    return {warning.partition(": ")[0] for warning in line["warnings"]}


@pytest.mark.parametrize(
    ("f", "is_warned", "is_refused"),
    [
        *((end, False, False) for end in (LEAST, LARGEST)),
        *((end, True, False) for end in (LEAST / 1.15, 1.15 * LARGEST)),
        *((end, True, True) for end in (LEAST / 1.3, 1.3 * LARGEST)),
    ],
)
def test_a_focal_length_beyond_the_training_is_warned_of_and_far_beyond_refused(
    phd_exp: Callable, run: str, tmp_path: Path, f: float, is_warned: bool, is_refused: bool
) -> None:
    folder = photos(tmp_path / "photos", [f])
    outcome = phd_exp("predict", run, f"image={folder / '0.png'}", f"f={f}")
    assert outcome.status == is_refused
    if is_refused:
        assert outcome.out == ""
        (error,) = outcome.err.splitlines()
        assert error.startswith(f"error: {folder / '0.png'}: focal_length: {f * SIDE / PIXELS:.4g} px")
        assert all(key in error for key in ("box=", "boxes=", "beyond=true"))
        outcome = phd_exp("predict", run, f"image={folder / '0.png'}", f"f={f}", "beyond=true")
        assert outcome.status == 0
    (line,) = read_lines(outcome.out)
    assert ("focal_length" in kinds(line)) == is_warned
    assert ("note: focal_length: 1 of 1 predictions, first " in outcome.err) == is_warned


def test_one_view_far_beyond_the_training_loses_no_other(phd_exp: Callable, run: str, tmp_path: Path) -> None:
    folder = photos(tmp_path / "photos", [2 * LARGEST, LARGEST, 1.1 * LARGEST])
    outcome = phd_exp("predict", run, f"folder={folder}")
    assert outcome.status == 1
    lines = read_lines(outcome.out)
    assert [line["file_name"] for line in lines] == ["1.png", "2.png"]
    assert ["focal_length" in kinds(line) for line in lines] == [False, True]
    assert "1 of 3 views are not predicted, first " in outcome.err
    anyway = phd_exp("predict", run, f"folder={folder}", "beyond=true")
    assert (anyway.status, len(read_lines(anyway.out))) == (0, 3)
    assert "note: focal_length: 2 of 3 predictions, first " in anyway.err


def test_a_refused_command_leaves_the_lines_of_an_earlier_one(phd_exp: Callable, run: str, tmp_path: Path) -> None:
    folder, out = photos(tmp_path / "photos", [LARGEST]), tmp_path / "out"
    words = ("predict", run, f"image={folder / '0.png'}", f"out={out}")
    assert phd_exp(*words, f"f={LARGEST}").status == 0
    before = (out / "predictions.jsonl").read_text()
    assert phd_exp(*words, f"f={2 * LARGEST}").status == 1
    assert (out / "predictions.jsonl").read_text() == before


def test_a_fused_scene_repeats_the_warnings_of_its_views(phd_exp: Callable, run: str, tmp_path: Path) -> None:
    folder = photos(tmp_path / "near", [LARGEST, 1.1 * LARGEST], scene=0, pose=HERE)
    outcome = phd_exp("fuse", run, f"folder={folder}")
    (line,) = read_lines(outcome.out)
    (warning,) = (one for one in line["warnings"] if one.startswith("focal_length: "))
    assert warning.endswith("; 1.png")
    assert "note: focal_length: 1 of 2 predictions, first " in outcome.err
    folder = photos(tmp_path / "far", [LARGEST, 1.3 * LARGEST], scene=0, pose=HERE)
    refused = phd_exp("fuse", run, f"folder={folder}")
    assert (refused.status, refused.out) == (1, "")
    assert "beyond=true" in refused.err
    assert len(read_lines(phd_exp("fuse", run, f"folder={folder}", "beyond=true").out)) == 1


def test_a_path_leaves_out_frames_far_beyond_the_training(phd_exp: Callable, run: str, tmp_path: Path) -> None:
    """The first one is refused."""
    f = 64 * LARGEST / PIXELS
    words = ("track", run, frames(tmp_path, f=dict.fromkeys(range(14), f) | {5: 1.3 * f}))
    outcome = phd_exp(*words)
    assert outcome.status == 0, outcome.err
    lines = read_lines(outcome.out)
    assert [k for k, line in enumerate(lines) if "focal_length" in kinds(line)] == [5]
    assert lines[5]["state"] == "bridged"
    assert math.isnan(float(lines[5]["surprise"] or "nan"))
    assert "note: focal_length: 1 of 14 frames, first " in outcome.err
    frames(tmp_path, f=dict.fromkeys(range(14), 1.3 * f))
    refused = phd_exp(*words)
    assert (refused.status, refused.out) == (1, "")
    assert all(key in refused.err for key in ("box=", "boxes=", "beyond=true"))
    assert len(read_lines(phd_exp(*words, "beyond=true").out)) == 14


def test_python_warns_of_focal_lengths(run: str) -> None:
    predictor = package.load(run.removeprefix("run="))
    image = np.zeros((2, PIXELS, PIXELS, 3), np.uint8)
    predictor(image, f=[LEAST, LARGEST])
    with pytest.warns(UserWarning, match=r"1 of 2 views, first focal_length: .* px; trained with .* px"):
        predictor(image, f=[LEAST, 1.1 * LARGEST])


def test_the_ranges_of_boxes_are_those_of_held_out_samples(
    phd_exp: Callable, make: Callable[..., RunFolder], tmp_path: Path
) -> None:
    (tmp_path / "part.obj").touch()
    camera = ("data.f=200", "data.width=200", "data.height=200")
    trained = make("data=object", f"data.mesh={tmp_path / 'part.obj'}", *camera)
    assert package.load(trained.path).ranges.focal_length == ANY
    sides, z = np.linspace(40, 60, 20), np.linspace(0.5, 1.0, 20)
    pd.DataFrame({"f": 200 * 224 / sides, "S": np.full(20, 224.0), "z": z}).to_parquet(trained.held_out)
    ranges = package.load(trained.path).ranges
    assert ranges.focal_length == pytest.approx((200 * SIDE / 60, 200 * SIDE / 40))
    assert (ranges.distance, ranges.box_size) == (pytest.approx((0.5, 1.0)), pytest.approx((0.1, 0.3)))
    assert ranges.edge == pytest.approx(0.5 / 1.5)  # data.edge_distance over the largest data.box_size
    folder = photos(tmp_path / "photos", [200.0])
    for side, refused in ((50, False), (64, False), (10, True), (190, True)):
        box = f"box={100 - side / 2},{100 - side / 2},{100 + side / 2},{100 + side / 2}"
        assert phd_exp("predict", f"run={trained.path}", f"image={folder / '0.png'}", "f=200", box).status == refused


RANGES = Ranges(focal_length=(300.0, 600.0), distance=(1.0, 2.0), box_size=(0.1, 0.25), edge=0.2, is_exact=False)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, set()),
        ({"z": 1.07}, set()),
        ({"z": 0.9, "side": 24.0}, {"distance"}),
        ({"z": 2.25}, {"distance"}),
        ({"side": 40.0}, {"focal_length", "box_size"}),
        ({"side": 31.0, "z": 1.9}, {"box_size"}),
        ({"left": 2.0, "x": -0.11}, {"cut_off"}),
        ({"left": 2.0, "x": 0.0}, set()),
        ({"familiar": 0.04}, {"unfamiliar"}),
        ({"familiar": 0.06}, set()),
    ],
)
def test_each_range_has_its_warning(changes: dict[str, float], expected: set[str]) -> None:
    """The network's image has 50 px, the photograph 200 px with f = 200 px, and a box in its left half."""
    given = {"z": 1.5, "x": 0.0, "side": 20.0, "left": 60.0, "familiar": 0.5} | changes
    left, side, z = given["left"], given["side"], given["z"]
    box = (left, 100 - side / 2, left + side, 100 + side / 2)
    camera = VirtualCamera.of_box(intrinsics(200.0, 200.0, 100.0, 100.0), box, 50.0)
    mode = np.array([given["x"], 0.0, z])
    warnings = RANGES.warnings(camera, mode, box, (200, 200), given["familiar"])
    assert {warning.partition(": ")[0] for warning in warnings} == expected

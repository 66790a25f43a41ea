"""`view=FILE.rrd`: recordings read back by Rerun's own reader, with a network of random weights."""

import io
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.path import Path as Outline
from PIL import Image

from phd_exp.distributions.surfaces import gaussian_radius
from phd_exp.geometry import Lens, intrinsics
from phd_exp.inference.ranges import Ranges
from phd_exp.records.runs import RunFolder
from tests.support.opencv import projected
from tests.support.rrd import Rows, read_rrd
from tests.support.untrained import NOWHERE, read_lines, read_metadata, write_metadata, write_photos

pytest.importorskip("rerun", reason="rerun-sdk is not installed: pip install 'phd_exp[rerun]'")
LEVELS = ("region_50", "region_90")


@pytest.fixture(scope="module")
def run(make: Callable[..., RunFolder]) -> str:
    """A run that predicts with usual precisions, whatever the image."""
    run = make(*NOWHERE)
    file = run.last_checkpoint
    weights = torch.load(file, weights_only=True)["state_dict"]
    weights["regressor.last.weight"] *= 0.01
    weights["regressor.last.bias"] = torch.tensor([0.3, -0.2, 20.0, 3.0, 30.0, 8.0, 1.0])
    torch.save({"state_dict": weights}, file)
    return f"run={run.path}"


def poses(folder: Path) -> list[dict[str, Any]]:
    """The lines of the photographs as two scenes with three cameras, which have seen the objects somewhere."""
    lines = read_metadata(folder)
    turned = [[math.cos(angle), 0.0, math.sin(angle), 0.0] for angle in (0.0, 0.03, -0.02)]
    for k, line in enumerate(lines):
        for key in ("x", "y", "z"):
            del line[key]
        line |= {"scene": k // 3, "pose": {"rotation": turned[k % 3], "translation": [0.01 * k, -0.05, 0.1]}}
    write_metadata(folder, lines)
    return lines


def seen(rows: Rows, time: Any, camera: str, vertices: np.ndarray) -> np.ndarray:
    """Where a recorded camera, by its transform and its pinhole (of which Rerun has the columns), sees positions."""
    R = np.reshape(rows[camera]["R"][time], (3, 3)).T
    K = np.reshape(rows[f"{camera}/image"]["K"][time], (3, 3)).T
    in_camera = (vertices - rows[camera]["t"][time]) @ R
    pixels = in_camera @ K.T
    return pixels[:, :2] / pixels[:, 2:]


def require_around(curve: np.ndarray, pixels: np.ndarray) -> None:
    """The curve is closed, has all pixels inside, and passes through some of them."""
    assert np.array_equal(curve[0], curve[-1])
    assert Outline(curve).contains_points(pixels, radius=0.05 * np.sign(area(curve))).all()
    assert np.linalg.norm(curve[:, None] - pixels, axis=-1).min(-1).max() < 0.02


def area(curve: np.ndarray) -> float:
    """Positive where the curve runs anticlockwise for matplotlib, whose radius then points outwards."""
    (x, y), (next_x, next_y) = curve[:-1].T, curve[1:].T
    return float((x * next_y - next_x * y).sum() / 2)


def test_regions_in_space_are_seen_inside_their_outlines(phd_exp: Callable, run: str, tmp_path: Path) -> None:
    """Crops are predicted in frames of their own; two boxes of one photograph are at one step."""
    write_photos(tmp_path / "photos", 2)
    lines = (tmp_path / "photos/metadata.jsonl").read_text().splitlines()
    second = json.dumps(json.loads(lines[0]) | {"box": [50, 20, 110, 80]})
    (tmp_path / "photos/metadata.jsonl").write_text("\n".join([lines[0], second, lines[1]]))
    outcome = phd_exp("predict", run, "folder=photos", "view=new/a.rrd")
    assert (outcome.status, outcome.err) == (0, "")
    rows = read_rrd(tmp_path / "new/a.rrd", "image")
    for answer, (time, k) in zip(read_lines(outcome.out), ((0, 0), (0, 1), (1, 0)), strict=True):
        with Image.open(tmp_path / "photos" / answer["file_name"]) as photo:
            assert Image.open(io.BytesIO(bytes(rows["/camera/image"]["blob"][time][0]))).size == photo.size
        np.testing.assert_allclose(rows[f"/objects/{k}/mode"]["positions"][time], [answer["mode"]], rtol=1e-5)
        for level in LEVELS:
            vertices = np.array(rows[f"/objects/{k}/{level}"]["positions"][time])
            curve = np.array(rows[f"/camera/image/objects/{k}/{level}"]["strips"][time][0])
            require_around(curve, seen(rows, time, "/camera", vertices))
        shape = rows[f"/objects/{k}/gaussian"]
        np.testing.assert_allclose(shape["centers"][time], [answer["mean"]], rtol=1e-5)
        variances = np.linalg.eigvalsh(answer["covariance"])
        np.testing.assert_allclose(shape["half_sizes"][time][0], gaussian_radius(0.9) * variances**0.5, rtol=1e-4)
    assert sorted(rows["/objects/1/mode"]["positions"]) == [0]


def test_an_outline_goes_through_the_lens(phd_exp: Callable, run: str, tmp_path: Path) -> None:
    K, lens = intrinsics(300.0, 310.0, 50.0, 40.0), Lens((-0.9, 0.4, 0.01, -0.02))
    Image.new("RGB", (120, 90), (90, 120, 0)).save(tmp_path / "a.png")
    values = {"width": 120, "height": 90, "K": [300.0, 0, 49.5, 0, 310.0, 39.5, 0, 0, 1], "D": lens.coefficients}
    (tmp_path / "bent.yaml").write_text(json.dumps(values | {"distortion_model": "plumb_bob"}))
    words = ("image=a.png", "camera=bent.yaml", "box=5,10,60,70", "view=a.rrd")
    assert phd_exp("predict", run, *words).status == 0
    rows = read_rrd(tmp_path / "a.rrd", "image")
    for level in LEVELS:
        vertices = np.array(rows[f"/objects/0/{level}"]["positions"][0])
        curve = np.array(rows[f"/camera/image/objects/0/{level}"]["strips"][0][0])
        require_around(curve, projected(vertices, K, lens))


def test_all_cameras_of_a_scene_see_the_regions_of_each(
    phd_exp: Callable, run: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_photos(tmp_path / "photos", 5)
    lines = poses(tmp_path / "photos")
    monkeypatch.setattr(Ranges, "of", lambda *_: Ranges(focal_length=(1e4, 1e5)))
    outcome = phd_exp("fuse", run, "folder=photos", "view=a.rrd", "beyond=true")
    assert outcome.err.startswith("note: focal_length: 5 of 5 predictions"), "notes come after the last view"
    answers = read_lines(outcome.out)
    rows = read_rrd(tmp_path / "a.rrd", "scene")
    for k in range(len(lines)):
        scene, camera = divmod(k, 3)
        for level in LEVELS:
            vertices = np.array(rows[f"/views/{camera}/{level}"]["positions"][scene])
            curve = np.array(rows[f"/cameras/{camera}/image/object/{level}"]["strips"][scene][0])
            require_around(curve, seen(rows, scene, f"/cameras/{camera}", vertices))
    fused = {k: answer["mean"] for k, answer in enumerate(answers) if answer["status"] == "fused"}
    assert fused
    found = rows["/fused/mean"]["positions"]
    assert found.keys() == fused.keys()
    for k, mean in fused.items():
        np.testing.assert_allclose(found[k], [mean], rtol=1e-5, atol=1e-6)


def test_a_path_has_its_times(phd_exp: Callable, run: str, tmp_path: Path) -> None:
    """Before its first box there is the camera alone."""
    write_photos(tmp_path / "photos", 1)
    (line,) = read_metadata(tmp_path / "photos")
    frames = [line | {"time": 0.5 + k / 20, "track": "ball"} for k in range(6)]
    del frames[0]["box"]
    write_metadata(tmp_path / "photos", frames)
    outcome = phd_exp("track", run, "folder=photos", "view=a.rrd")
    answers = read_lines(outcome.out)
    rows = read_rrd(tmp_path / "a.rrd", "time")
    for n, (answer, time) in enumerate(zip(answers, sorted(rows["/ball/camera"]["t"]), strict=True)):
        assert time.total_seconds() == pytest.approx(answer["time"])
        if n == 0:
            assert answer["state"] == "lost"
            assert not rows["/ball/path"]["strips"].get(time)
            assert not rows["/ball/depth"]["scalars"].get(time)
            continue
        np.testing.assert_allclose(rows["/ball/path"]["strips"][time][0][-1], answer["mean"], rtol=1e-5)
        assert len(rows["/ball/path"]["strips"][time][0]) == n
        low, middle, high = rows["/ball/depth"]["scalars"][time]
        np.testing.assert_allclose([low, high], answer["depth_interval"]["90"], rtol=1e-3)
        assert middle == pytest.approx(answer["mean"][2])
        curve = np.array(rows["/ball/camera/image/object/region_90"]["strips"][time][0])
        require_around(curve, np.concatenate([curve, seen(rows, time, "/ball/camera", np.array([answer["mean"]]))]))


def test_a_recording_is_new_and_whole_before_a_bad_image(phd_exp: Callable, run: str, tmp_path: Path) -> None:
    write_photos(tmp_path / "photos", 2)
    (tmp_path / "a.rrd").write_text("earlier")
    for word, said in (
        ("view=a.rrd", "view=a.rrd: holds other data than this command writes; expected a new file, "),
        ("view=photos", "view: got photos; expected a file *.rrd, such as view.rrd"),
    ):
        outcome = phd_exp("predict", run, "folder=photos", word)
        assert (outcome.status, said in outcome.error) == (2, True)
    assert (tmp_path / "a.rrd").read_text() == "earlier"
    (tmp_path / "photos/1.png").write_bytes(b"no image")
    assert phd_exp("predict", "folder=photos", run, "view=c.rrd").status == 1
    assert sorted(read_rrd(tmp_path / "c.rrd", "image")["/camera"]["t"]) == [0]

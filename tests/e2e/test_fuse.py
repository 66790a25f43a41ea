"""Scenes of several cameras become one position each; scenes that cannot be fused, and mistakes of a user."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

import phd_exp as package
from phd_exp.__main__ import main
from phd_exp.geometry import intrinsics
from phd_exp.records.runs import RunFolder
from tests.e2e.conftest import QUICK
from tests.support.several import write_views
from tests.support.untrained import read_lines, read_metadata, write_metadata

VIEWS, SCENES = 3, 2


@pytest.fixture(scope="module")
def several(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The test split of a rendered data set of several views."""
    root = tmp_path_factory.mktemp("several")
    sizes = ("data.n_train=2", "data.n_held_out=0", f"data.n_test={VIEWS * SCENES}", "data.batch_size=2")
    views = ("data=multiview", f"data.views={VIEWS}")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["phd_exp"])
        assert main(["render", *QUICK, *sizes, *views, f"data.root={root}"]) == 0
    return root / "multiview" / "test"


def matrix(line: dict[str, Any]) -> np.ndarray:
    w, x, y, z = line["pose"]["rotation"]
    return Rotation.from_quat([x, y, z, w]).as_matrix()


def require_most_likely(run: RunFolder, folder: Path, views: list[dict[str, Any]], point: list[float]) -> None:
    """All positions nearby are less likely, by the densities of the views, each predicted alone."""
    predictor = package.load(run.path)
    around = 0.02 * np.random.default_rng(0).standard_normal((1000, 3))
    tried = np.concatenate([np.zeros((1, 3)), around]) + point
    energy = torch.zeros(len(tried), dtype=torch.float64)
    for line in views:
        image = np.asarray(Image.open(folder / line["file_name"]).convert("RGB"))
        height, width = image.shape[:2]
        f = line.get("f", line.get("fx"))
        K = intrinsics(f, line.get("fy", f), line.get("cx", width / 2), line.get("cy", height / 2))
        view = predictor.view(image, K, line.get("box"))
        seen = view.camera.to_virtual(tried @ matrix(line).T + line["pose"]["translation"])
        energy -= predictor.see([view]).log_prob(torch.from_numpy(seen)).double()
    assert bool((energy[0] < energy[1:]).all())


def test_the_test_split_of_a_rendered_set_is_fused_as_it_is(phd_exp: Callable, run: RunFolder, several: Path) -> None:
    outcome = phd_exp("fuse", f"run={run.path}", f"folder={several}")
    assert (outcome.status, outcome.err) == (0, "")
    rows, lines = read_lines(outcome.out), read_metadata(several)
    assert [row["scene"] for row in rows] == list(range(SCENES))
    for row in rows:
        views = [line for line in lines if line["scene"] == row["scene"]]
        assert row["file_names"] == [line["file_name"] for line in views]
        assert row["status"] == "fused"
        assert len(row["surprise"]) == VIEWS
        assert 0 <= min(row["surprise"]) <= max(row["surprise"]) <= 1
        truth = np.array([views[0][axis] for axis in "xyz"])  # the world is the frame of view 0
        assert row["error_mm"] == pytest.approx(1000 * np.linalg.norm(truth - row["point"]), rel=1e-5)
        off = truth - row["mean"]
        distance = off @ np.linalg.inv(row["covariance"]) @ off
        assert row["squared_mahalanobis"] == pytest.approx(distance, rel=1e-5)
    views = lines[VIEWS : 2 * VIEWS]
    require_most_likely(run, several, views, rows[1]["point"])


def test_on_a_plane_positions_and_their_uncertainty_lie_in_it(
    phd_exp: Callable, run: RunFolder, several: Path
) -> None:
    outcome = phd_exp("fuse", f"run={run.path}", f"folder={several}", "plane=[0,0.6,0.8,3.2]")
    assert (outcome.status, outcome.err) == (0, "")
    normal = np.array([0, 0.6, 0.8])
    for row in read_lines(outcome.out):
        assert normal @ row["point"] == pytest.approx(3.2)
        assert normal @ row["mean"] == pytest.approx(3.2)
        values, directions = np.linalg.eigh(row["covariance"])
        assert values[0] == pytest.approx(0, abs=1e-7 * values[2])
        assert abs(directions[:, 0] @ normal) == pytest.approx(1)
        assert row["squared_mahalanobis"] > 0


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """Crops of noise by cameras that stand close together; one scene of two of them, one of three, one of one."""
    folder, draw = tmp_path / "photos", np.random.default_rng(0)
    folder.mkdir()
    lines = []
    for index, scene in enumerate(["two", "three", "one", "three", "two", "three"]):
        noise = draw.integers(0, 256, (90, 120, 3), dtype=np.uint8)
        Image.fromarray(noise).save(folder / f"{index}.png")
        x, y, z, w = Rotation.from_rotvec(0.05 * draw.standard_normal(3)).as_quat()
        pose = {"rotation": [w, x, y, z], "translation": (0.05 * draw.standard_normal(3)).tolist()}
        camera = {"fx": 300.0, "fy": 310.0, "cx": 50.0, "cy": 40.0, "box": [20, 10, 72, 62 + index]}
        lines.append({"file_name": f"{index}.png", "scene": scene, "pose": pose} | camera)
    write_metadata(folder, lines)
    return folder


def test_crops_of_any_cameras_are_fused_in_the_world_of_their_poses(
    phd_exp: Callable, run: RunFolder, photos: Path, tmp_path: Path
) -> None:
    outcome = phd_exp("fuse", f"run={run.path}", f"folder={photos}", "out=there/fused.jsonl")
    assert (outcome.status, outcome.out) == (0, ""), outcome.err
    rows, lines = read_lines((tmp_path / "there" / "fused.jsonl").read_text()), read_metadata(photos)
    assert [(row["scene"], len(row["surprise"])) for row in rows] == [("two", 2), ("three", 3), ("one", 1)]
    assert all("error_mm" not in row for row in rows)
    for row in rows:
        views = [line for line in lines if line["scene"] == row["scene"]]
        require_most_likely(run, photos, views, row["point"])
    # alone, a view's most likely position is its mode
    alone = read_lines(phd_exp("predict", f"run={run.path}", f"folder={photos}").out)[2]
    pose = lines[2]["pose"]
    world = matrix(lines[2]).T @ (np.array(alone["mode"]) - pose["translation"])
    np.testing.assert_allclose(rows[2]["point"], world, rtol=1e-5, atol=1e-5)
    # a scene does not depend on what else is in the file
    write_metadata(photos, [line for line in lines if line["scene"] == "three"])
    (three,) = read_lines(phd_exp("fuse", f"run={run.path}", f"folder={photos}").out)
    np.testing.assert_allclose(three["point"], rows[1]["point"], rtol=1e-5)
    np.testing.assert_allclose(three["covariance"], rows[1]["covariance"], rtol=1e-4)


def test_a_scene_that_fails_says_why_and_harms_no_other(phd_exp: Callable, run: RunFolder, photos: Path) -> None:
    before = read_lines(phd_exp("fuse", f"run={run.path}", f"folder={photos}").out)
    lines = read_metadata(photos)
    back_to_back = {"rotation": [0.0, 0.0, 1.0, 0.0], "translation": [0.0, 0.0, 0.0]}
    lines[4]["pose"] = back_to_back
    lines[0]["pose"] = {"rotation": [1.0, 0.0, 0.0, 0.0], "translation": [0.0, 0.0, 0.0]}
    write_metadata(photos, lines)
    outcome = phd_exp("fuse", f"run={run.path}", f"folder={photos}")
    assert outcome.status == 1
    error = outcome.err.splitlines()[-1]
    assert error == "error: 1 of 3 scenes have no fused position: two; the line of each says why"
    failed, *others = read_lines(outcome.out)
    assert (failed["status"], failed["point"]) == ("contradiction", [None] * 3)
    assert failed["reason"].startswith("at least half of the views rule out")
    for row, same in zip(others, before[1:], strict=True):
        np.testing.assert_allclose(row["point"], same["point"], rtol=1e-6)


def test_recalibration_reaches_the_fused_covariance(phd_exp: Callable, run: RunFolder, several: Path) -> None:
    words = ("fuse", f"run={run.path}", f"folder={several}")
    before, after = read_lines(phd_exp(*words).out), read_lines(phd_exp(*words, "recalibrate=true").out)
    assert after[0]["uncertainty"].startswith("recalibrated: A / ")
    assert after[0]["covariance"] != before[0]["covariance"]


def test_a_shared_scale_is_estimated_with_the_spread_of_the_runs_own_scenes(
    phd_exp: Callable, run: RunFolder, several: Path
) -> None:
    words = ("fuse", f"run={run.path}", f"folder={several}")
    refused = phd_exp(*words, "shared_scale=true")
    assert "views.parquet: missing; shared_scale is estimated from it: train with evaluation" in refused.error
    assert refused.out == ""
    write_views(run.views, 40, a=30.0, common=0.1)
    before, after = read_lines(phd_exp(*words).out), read_lines(phd_exp(*words, "shared_scale=true").out)
    run.views.unlink()
    for alone, shared in zip(before, after, strict=True):
        assert shared.keys() - alone.keys() == {"shared_scale"}
        assert shared["status"] == "fused"
        assert shared["shared_scale"] > 0
        assert shared["covariance"] != alone["covariance"]


def test_truths_that_contradict_the_poses_are_found_before_anything_is_predicted(
    phd_exp: Callable, run: RunFolder, several: Path, tmp_path: Path
) -> None:
    lines = read_metadata(several)
    lines[1]["pose"] = lines[2]["pose"]
    write_metadata(tmp_path, lines)  # without the images
    outcome = phd_exp("fuse", f"run={run.path}", "folder=.")
    assert "line 2: its x, y, z and pose place the object of scene 0" in outcome.error

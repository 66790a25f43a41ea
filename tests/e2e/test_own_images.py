"""Own images from files to a run record; rendered images replace photographs, because their truth is known."""

import importlib.util
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from scipy import ndimage
from scipy.spatial.transform import Rotation

from phd_exp.data.crops import cut
from phd_exp.data.folder import FolderSource
from phd_exp.geometry.virtual import Box, VirtualCamera, intrinsics
from phd_exp.records.dataset import DatasetFolder, sha256
from phd_exp.records.detections import DetectionFolder
from phd_exp.records.scenes import SampleRecord, Scene
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.pixels import encoded
from phd_exp.rendering.rays import trace_pixels
from phd_exp.rendering.render import ensure_rendered
from phd_exp.rendering.samples import backdrop_light
from tests.e2e.runs import only_run
from tests.support.renders import silhouettes
from tests.support.untrained import read_lines, virtual_cameras

N_TRAIN, N_TEST = 10, 2
SIDE = 96


@pytest.fixture(scope="module")
def spec(make_spec: Callable[..., DatasetSpec]) -> DatasetSpec:
    """Cylinders that lie within the image as a whole."""
    return make_spec("default", xy_range=0.5)


@pytest.fixture(scope="module")
def rendered(spec: DatasetSpec, tmp_path_factory: pytest.TempPathFactory) -> DatasetFolder:
    folder = DatasetFolder(tmp_path_factory.mktemp("own") / "default")
    ensure_rendered(folder, spec, N_TRAIN, N_TEST, workers=1)
    return folder


def box_about(scene: Scene) -> Box:
    """A box with the object anywhere but in its middle."""
    rows, columns = np.nonzero(silhouettes(trace_pixels(scene)))
    return columns.min() - 12.0, rows.min() - 20.0, columns.max() + 25.0, rows.max() + 9.0


@pytest.fixture(scope="module")
def photos(rendered: DatasetFolder) -> Path:
    """The same images as somebody else would hand them over: nothing but camera, box and position."""
    folder = rendered.root.parent / "photos"
    for split in ("train", "test"):
        (folder / split).mkdir(parents=True)
        lines = []
        for record in rendered.records(split):  # type: ignore[arg-type]
            image = rendered.image_path(split, record.index)  # type: ignore[arg-type]
            (folder / split / image.name).write_bytes(image.read_bytes())
            line = {"file_name": image.name, "f": record.f, "box": box_about(record.shown)}
            lines.append(json.dumps(line | {"x": record.x, "y": record.y, "z": record.z}) + "\n")
        (folder / split / "metadata.jsonl").write_text("".join(lines))
    return folder


def seen_by(camera: VirtualCamera, scene: Scene, finer: int) -> Scene:
    """The scene in the frame of a virtual camera, on `finer` times as many pixels."""
    objects = []
    for item in scene.objects:
        rotation = Rotation.from_matrix(camera.R) * Rotation.from_quat(item.rotation, scalar_first=True)
        turned = tuple(rotation.as_quat(scalar_first=True).tolist())
        position = tuple(camera.to_virtual(np.array(item.position)))
        objects.append(item.model_copy(update={"position": position, "rotation": turned}))
    update = {"f": finer * camera.f, "S": finer * int(camera.S), "objects": tuple(objects)}
    return scene.model_copy(update=update)


def centroid(mask: np.ndarray) -> np.ndarray:
    rows, columns = np.nonzero(mask)
    return np.array([(columns + 0.5).mean(), (rows + 0.5).mean()])


def shown(folder: DatasetFolder, record: SampleRecord, camera: VirtualCamera) -> np.ndarray:
    """Pixels of the virtual image that show the object: those that differ from the backdrop, seen the same way.

    An edge lies where the difference is half of the largest within three pixels.
    """
    with Image.open(folder.image_path("train", record.index)) as image:
        seen = cut(image.convert("RGB"), camera).astype(float)
    backdrop = cut(Image.fromarray(encoded(backdrop_light(record.backdrop, record.S))), camera)
    difference = np.abs(seen - backdrop).max(axis=-1)
    contrast = ndimage.maximum_filter(difference, 7)
    return ndimage.binary_fill_holes((difference > 0.5 * contrast) & (contrast > 16))


def test_a_rendered_image_seen_in_a_box_shows_the_object_where_the_virtual_camera_sees_it(
    rendered: DatasetFolder,
) -> None:
    # the rim of a metal object may be of the backdrop's own colour
    records = [record for record in rendered.records("train") if record.objects[0].material == "rubber"]
    off = []
    for record in records:
        K = intrinsics(record.f, record.f, record.S / 2, record.S / 2)
        camera = VirtualCamera.of_box(K, box_about(record.shown), float(SIDE))
        expected = centroid(silhouettes(trace_pixels(seen_by(camera, record.shown, finer=4)))) / 4
        assert np.abs(expected - SIDE / 2).max() > 2  # the object is not in the middle
        off.append(centroid(shown(rendered, record, camera)) - expected)
    assert len(off) >= 4
    assert np.abs(off).max() < 0.1


@pytest.fixture
def train(phd_exp: Callable, photos: Path, monkeypatch: pytest.MonkeyPatch) -> Callable:
    """A run on the photographs, on a machine without Blender."""
    real = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *more: None if name == "bpy" else real(name, *more))
    quick = ("preset=smoke", "data=folder", "data.batch_size=4", "trainer.progress_bar=false")
    quick += ("trainer.threads=1", "logger=none", "data.name=mycams")
    return lambda *arguments: phd_exp(*quick, f"data.folder={photos}", *arguments)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("runs")


@pytest.mark.parametrize("model", ["probabilistic", pytest.param("mae_constf", marks=pytest.mark.slow)])
def test_a_run_on_own_images_leaves_a_whole_record_and_predicts_the_same(
    train: Callable, phd_exp: Callable, photos: Path, runs: Path, model: str
) -> None:
    outcome = train(f"model={model}", f"runs={runs / model}")
    assert outcome.status == 0, outcome.err
    run = only_run(runs / model)
    assert run.path.relative_to(runs / model).as_posix().startswith(f"smoke/mycams/{model}/seed0-")
    results = run.results()
    assert (results["data"], results["n_train"], results["n_test"]) == ("mycams", N_TRAIN, N_TEST)
    assert np.isfinite(results["test/depth_error_mm"])
    status = run.status()
    assert status is not None
    assert status.data_manifest == DetectionFolder(photos).fingerprint()
    table = pd.read_parquet(run.predictions)
    assert {"file_name", "f", "S", "x", "y", "z"} <= set(table.columns)
    assert not {"scale", "visibility"} & set(table.columns)
    (crop, *_) = FolderSource(DetectionFolder(photos), None, 0, None, 64).crops["test"]
    np.testing.assert_allclose(table.loc[0, ["x", "y", "z"]].astype(float), crop.xyz, rtol=1e-6)
    assert table.loc[0, "f"] == crop.camera.f
    rows = read_lines(phd_exp("predict", f"run={run.path}", f"folder={photos / 'test'}").out)
    modes = table[["mode_x", "mode_y", "mode_z"]].to_numpy()
    for row, mode, camera in zip(rows, modes, virtual_cameras(photos / "test", 64), strict=True):
        place = row["mode" if model == "probabilistic" else "position"]
        np.testing.assert_allclose(place, camera.to_real(mode), rtol=1e-5, atol=1e-5)
    for key in ("depth_error_mm", "projected_error_mm"):
        np.testing.assert_allclose([row[key] for row in rows], table[key], rtol=1e-3, atol=1e-2)


def test_a_run_on_other_data_is_never_reused(train: Callable, photos: Path, runs: Path, tmp_path: Path) -> None:
    """Neither with other metadata of the same name, nor from another folder."""
    assert train(f"runs={runs / 'probabilistic'}").status == 0
    shutil.copytree(runs / "probabilistic", tmp_path / "runs")
    assert "finished already" in train().out
    metadata = photos / "train" / "metadata.jsonl"
    before = metadata.read_text()
    metadata.write_text(before + "\n")
    outcome = train()
    metadata.write_text(before)
    assert outcome.status == 1
    (line,) = outcome.err.splitlines()
    assert "as it was before its metadata.jsonl changed" in line
    run = only_run(tmp_path / "runs")
    config = run.config()
    assert config["data"]["folder"] == str(photos)
    config["data"]["folder"] = "elsewhere"
    run.write_config(config)
    outcome = train()
    assert outcome.status == 1
    assert f"data.folder=elsewhere, but data.folder={photos} is asked for" in outcome.err


def test_too_few_images_for_a_batch_is_one_line_and_nothing_is_written(train: Callable, tmp_path: Path) -> None:
    outcome = train("data.batch_size=11")
    assert outcome.status == 2
    assert outcome.err == (
        f"error: data: batch_size=11 is larger than the {N_TRAIN} training samples there are: not one batch is full; "
        "choose a smaller data.batch_size\n"
    )
    assert list(tmp_path.iterdir()) == []


def test_the_fingerprint_is_of_what_the_files_say(photos: Path) -> None:
    digests = [sha256((photos / split / "metadata.jsonl").read_bytes()) for split in ("train", "test")]
    assert DetectionFolder(photos).fingerprint() == sha256("".join(digests).encode())

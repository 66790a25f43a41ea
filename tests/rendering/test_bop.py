"""A rendered data set as BOP and back, and its models against theory."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from phd_exp.records.dataset import SPLITS, DatasetFolder, sha256
from phd_exp.records.own_images import detections_in, observed
from phd_exp.records.scenes import SampleRecord, Split
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.bop import number_of, write_bop
from phd_exp.rendering.objects import sample_object_scene
from phd_exp.rendering.rays import FACES, NOTHING, trace_pixels
from phd_exp.rendering.samples import describe
from phd_exp.rendering.sampling import sample_scene
from tests.support.handmade import write_sealed
from tests.support.meshes import solid, write_mesh
from tests.support.renders import MakeSpec

SIDE, N = 56, 6
MESHES = {"mesh": solid("cube", 0.15, middle=(0.05, 0.0, 0.02))}
VARIANTS: dict[str, dict[str, Any]] = {
    "occl_scale": {}, "multiview": {"views": 3}, "hidden": {"half_hidden": True, "image_format": "jpeg"},
    "object": {"backdrops": None, "distractors": 2},
}  # fmt: skip


@pytest.fixture(scope="module", params=VARIANTS)
def folder(
    request: pytest.FixtureRequest, make_spec: MakeSpec, tmp_path_factory: pytest.TempPathFactory
) -> DatasetFolder:
    """Records as they are rendered, and noise as images: nothing here depends on what an image shows."""
    place = tmp_path_factory.mktemp("renders")
    changes = {"sensor_size": SIDE, "f_range": (300.0, 500.0)} | VARIANTS[request.param]
    if request.param == "object":
        changes["mesh"] = str(write_mesh(place / "part.stl", MESHES["mesh"]))
    return drawn(place / request.param, make_spec(request.param, **changes))


def drawn(root: Path, spec: DatasetSpec) -> DatasetFolder:
    def recorded(split: Split, index: int, content: bytes) -> SampleRecord:
        scene = sample_object_scene(spec, split, index, MESHES) if spec.mesh else sample_scene(spec, split, index)
        return describe(spec, split, index, scene, trace_pixels(scene, MESHES), sha256(content), MESHES)

    return write_sealed(DatasetFolder(root), spec, dict.fromkeys(SPLITS, N), recorded, SIDE)


@pytest.fixture(scope="module")
def bop(folder: DatasetFolder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("bop")
    assert write_bop(folder, target, MESHES) == len(SPLITS) * N
    return target


def records(folder: DatasetFolder) -> list[tuple[SampleRecord, str]]:
    """Each record, and the scene of its image."""
    several = folder.manifest.spec.views > 1
    return [(record, f"{record.scene * several:06d}") for split in SPLITS for record in folder.records(split)]


def table(bop: Path, record: SampleRecord, scene: str, name: str) -> Any:
    return json.loads((bop / record.split / scene / f"scene_{name}.json").read_text())[str(record.index)]


def first_model(folder: DatasetFolder) -> int:
    return number_of("mesh" if folder.manifest.spec.mesh else "cylinder")


def test_poses_return_to_1e9(folder: DatasetFolder, bop: Path) -> None:
    """Of every object, from its corners: a corner of the model is where the renderer has it."""
    for record, scene in records(folder):
        w, *xyz = record.pose.rotation
        camera = Rotation.from_quat([*xyz, w])
        for item, pose in zip(record.objects, table(bop, record, scene, "gt"), strict=True):
            assert pose["obj_id"] == number_of(item.shape)
            corner = 0.5 * np.array(item.dimensions) * item.scale
            w, *xyz = item.rotation
            there = (
                camera.apply(Rotation.from_quat([*xyz, w]).apply(corner) + item.position) + record.pose.translation
            )
            R, t = np.reshape(pose["cam_R_m2c"], (3, 3)), np.array(pose["cam_t_m2c"])
            np.testing.assert_allclose((R @ (1000 * corner) + t) / 1000, there, atol=1e-9, rtol=0)


def test_detections_return(folder: DatasetFolder, bop: Path) -> None:
    """Position, camera and size of the cylinder, and each image byte for byte."""
    for split in SPLITS:
        found = {int(line.file.stem): line for line in detections_in(bop / split, object_name=first_model(folder))}
        for record in folder.records(split):
            detection = found.pop(record.index, None)
            if detection is None:
                assert record.visibility == 0
                continue
            np.testing.assert_allclose(detection.position, (record.x, record.y, record.z), atol=1e-9, rtol=0)
            assert detection.optics(SIDE, SIDE)[0].tolist() == [
                [record.f, 0, SIDE / 2],
                [0, record.f, SIDE / 2],
                [0, 0, 1],
            ]
            assert detection.line.scale == record.scale
            assert detection.line.visibility == pytest.approx(record.visibility * (1 - record.truncation))
            assert detection.file.read_bytes() == (folder.split_folder(split) / record.file_name).read_bytes()
        assert not found


def test_masks_pixel_for_pixel_and_their_boxes(folder: DatasetFolder, bop: Path) -> None:
    """Each pixel shows the object that its ray hits first."""
    for record, scene in records(folder):
        first = trace_pixels(record.as_scene, MESHES).first
        for number, info in enumerate(table(bop, record, scene, "gt_info")):
            name = f"{record.index:06d}_{number:06d}.png"
            mask = np.asarray(Image.open(bop / record.split / scene / "mask_visib" / name))
            expected = (first != NOTHING) & ((first.astype(int) - 1) // FACES == number)
            assert (mask == 255 * expected).all()
            assert info["px_count_visib"] == expected.sum() <= info["px_count_valid"] <= info["px_count_all"]
            assert info["visib_fract"] * info["px_count_all"] == pytest.approx(info["px_count_visib"])
            x, y, width, height = info["bbox_visib"]
            if expected.any():
                inside = expected[y : y + height + 1, x : x + width + 1]
                assert inside.sum() == expected.sum()
                assert all(edge.any() for edge in (inside[0], inside[-1], inside[:, 0], inside[:, -1]))
                left, top, across, down = info["bbox_obj"]
                assert left <= x
                assert top <= y
                assert x + width <= left + across
                assert y + height <= top + down
            else:
                assert (x, y, width, height) == (-1, -1, -1, -1)


def test_views_of_a_scene_are_poses_in_its_frame(folder: DatasetFolder, bop: Path) -> None:
    found = detections_in(bop / "train")
    if folder.manifest.spec.views == 1:
        assert all(detection.line.pose is None for detection in found)
        return
    poses = {record.index: record.pose for record in folder.records("train")}
    scenes = observed(detections_in(bop / "train", object_name=1))
    assert [len(scene.detections) for scene in scenes] == [3] * (N // 3)
    for scene in scenes:
        for detection, pose in zip(scene.detections, scene.poses, strict=True):
            expected = poses[int(detection.file.stem)]
            sign = np.sign(np.dot(pose.rotation, expected.rotation))
            np.testing.assert_allclose(sign * np.array(pose.rotation), expected.rotation, atol=1e-9)
            np.testing.assert_allclose(pose.translation, expected.translation, atol=1e-9)


def read_ply(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles."""
    lines = file.read_text().split("\n")
    n = next(int(line.split()[-1]) for line in lines if line.startswith("element vertex"))
    start = lines.index("end_header") + 1
    faces = np.array([line.split() for line in lines[start + n :] if line], dtype=int)
    assert (faces[:, 0] == 3).all()
    return np.array([line.split() for line in lines[start : start + n]], dtype=float), faces[:, 1:]


def test_models_have_the_volume_size_and_symmetries_of_the_solids(folder: DatasetFolder, bop: Path) -> None:
    infos = json.loads((bop / "models" / "models_info.json").read_text())
    shapes = {item.shape: item for record, _ in records(folder) for item in record.objects}
    assert infos.keys() == {str(number_of(shape)) for shape in shapes}
    for shape, item in shapes.items():
        info, size = infos[str(number_of(shape))], 1000 * np.array(item.dimensions)
        vertices, faces = read_ply(bop / "models" / f"obj_{number_of(shape):06d}.ply")
        a, b, c = (vertices[faces[:, corner]] for corner in range(3))
        volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6  # positive if all faces are seen from outside
        share = {"cylinder": np.pi / 4, "cube": 1.0, "sphere": np.pi / 6, "mesh": 1.0}[shape]
        assert volume == pytest.approx(share * size.prod(), rel=1e-3)
        for place, axis in enumerate("xyz"):
            assert info[f"min_{axis}"] == pytest.approx(vertices[:, place].min())
            assert info[f"size_{axis}"] == pytest.approx(np.ptp(vertices[:, place]))
        distances = np.linalg.norm(vertices[:, None] - vertices[None, :: len(vertices) // 8 + 1], axis=-1)
        assert info["diameter"] == pytest.approx(distances.max(), rel=1e-5)
        if shape == "mesh":
            assert not {"symmetries_discrete", "symmetries_continuous"} & info.keys()
            continue
        count = {"cylinder": 7, "cube": 23 if np.ptp(size) == 0 else 3, "sphere": 23}[shape]
        assert len(info["symmetries_discrete"]) == count
        for matrix in info["symmetries_discrete"]:
            R = np.reshape(matrix, (4, 4))[:3, :3]
            assert np.linalg.det(R) == pytest.approx(1)
            gaps = np.linalg.norm((vertices[::500] @ R.T)[:, None] - vertices, axis=-1).min(axis=1)
            assert gaps.max() < 0.02 * size.max()  # circles are polygons
        assert [axis["axis"] for axis in info["symmetries_continuous"]] == {
            "cylinder": [[0, 0, 1]], "cube": [], "sphere": np.eye(3).tolist()
        }[shape]  # fmt: skip

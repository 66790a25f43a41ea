"""Write a rendered data set in the format of BOP, which `records/foreign.py` reads.

    <bop>/models/                  obj_000001.ply (cylinder), 2 (cube), 3 (sphere), 4 and more (meshes, whose
                                   symmetries are unknown), and models_info.json, all in mm
    <bop>/<split>/000000/          all images; of a data set with several views, those of one scene
        mask_visib/000123_000001.png    white where image 123 shows its object 1

Source: bop_toolkit, docs/bop_datasets_format.md, scripts/calc_gt_info.py and scripts/calc_model_info.py.
"""

import json
from collections import defaultdict
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial import ConvexHull
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from phd_exp.optics.virtual import product
from phd_exp.records.cameras import CORNER
from phd_exp.records.dataset import SPLITS, DatasetFolder
from phd_exp.records.errors import writing
from phd_exp.records.foreign import METRE
from phd_exp.records.images import content_of
from phd_exp.records.scenes import SHAPES, SampleRecord
from phd_exp.records.written import Written
from phd_exp.rendering import rays
from phd_exp.rendering.meshes import build_mesh
from phd_exp.rendering.pixels import file_of
from phd_exp.rendering.progress import shown_progress
from phd_exp.rendering.triangles import NO_MESHES, Meshes, Triangles

ROUND_ABOUT = {"cylinder": [[0, 0, 1]], "cube": [], "sphere": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}


def number_of(shape: str) -> int:
    """The number of an object's model: 1 to 3 for the solids, 4 for `mesh`, 5 for `mesh1`, ..."""
    return SHAPES.index(shape) + 1 if shape in SHAPES else len(SHAPES) + 1 + int(shape.removeprefix("mesh") or 0)


def write_bop(folder: DatasetFolder, bop: Path, meshes: Meshes = NO_MESHES) -> int:
    """Write all samples of a data set as BOP, the images byte for byte; returns how many.

    An object has the additional key `scale`, the factor on the size of its model.

    Raises DatasetError if there is no data set, or a broken one, RenderError if files cannot be written.
    """
    records = [record for split in SPLITS for record in folder.records(split)]
    several = folder.manifest.spec.views > 1
    with (
        writing(bop, instead="bop=FOLDER"),
        Written(bop, "bop") as written,
        shown_progress(len(records), "writing BOP") as advance,
    ):
        for (split, scene), images in groupby(records, lambda record: (record.split, several * record.scene)):
            target, tables = f"{split}/{scene:06d}", defaultdict[str, dict[int, Any]](dict)
            for record in images:
                content = content_of(folder.split_folder(split) / record.file_name)
                written.write(f"{target}/rgb/{record.file_name}", content)
                hits, numbers = rays.trace_pixels(record.as_scene, meshes), range(len(record.objects))
                tables["gt"][record.index] = [_pose(record, number) for number in numbers]
                tables["gt_info"][record.index] = [
                    _write_mask(record, number, hits, meshes, written, target) for number in numbers
                ]
                tables["camera"][record.index] = _camera(record, several)
                advance()
            for name, table in tables.items():
                written.write(f"{target}/scene_{name}.json", json.dumps(table))
        sizes = {item.shape: METRE * np.array(item.dimensions) for record in records for item in record.objects}
        models = {
            number_of(shape): _write_model(shape, size, meshes.get(shape), written) for shape, size in sizes.items()
        }
        written.write("models/models_info.json", json.dumps(models))
    return len(records)


def _camera(record: SampleRecord, several: bool) -> dict[str, Any]:
    f, middle = record.f, record.S / 2 - CORNER
    camera = {"cam_K": [f, 0, middle, 0, f, middle, 0, 0, 1], "depth_scale": 1.0}
    world = {"cam_R_w2c": rays.rotation_matrix(record.pose.rotation).ravel().tolist()}
    return camera | (world | {"cam_t_w2c": [METRE * value for value in record.pose.translation]} if several else {})


def _pose(record: SampleRecord, number: int) -> dict[str, Any]:
    item, rotation = record.objects[number], rays.rotation_matrix(record.pose.rotation)
    return {
        "obj_id": number_of(item.shape),
        "cam_R_m2c": product(rotation, rays.rotation_matrix(item.rotation)).ravel().tolist(),
        "cam_t_m2c": (METRE * rays.in_camera_frame(np.array(item.position), record.pose)).tolist(),
        "scale": item.scale,
    }


def _write_mask(
    record: SampleRecord, number: int, hits: rays.Hits, meshes: Meshes, written: Written, target: str
) -> dict[str, Any]:
    """Write the mask of an object; returns its boxes and pixels, of which those outside the image are not visible."""
    mask = rays.cylinder_mask(hits, number)
    whole, around = rays.silhouette(record.as_scene, number, meshes)
    name = f"{target}/mask_visib/{record.index:06d}_{number:06d}.png"
    written.write(name, file_of(Image.fromarray(np.uint8(255) * mask), "png"))
    return {
        "bbox_obj": _box(whole, around.left, around.top),
        "bbox_visib": _box(mask),
        "px_count_all": int(whole.sum()),
        "px_count_valid": int(np.isfinite(hits.depths[number]).sum()),
        "px_count_visib": int(mask.sum()),
        "visib_fract": float(mask.sum() / max(whole.sum(), 1)),
    }


def _box(mask: rays.Mask, left: int = 0, top: int = 0) -> list[int]:
    """First column and row, and the differences to the last ones; -1 if there is no pixel."""
    rows, columns = np.nonzero(mask)
    if not len(rows):
        return [-1] * 4
    return [int(value) for value in (columns.min() + left, rows.min() + top, np.ptp(columns), np.ptp(rows))]


def _write_model(shape: str, size: np.ndarray, mesh: Triangles | None, written: Written) -> dict[str, Any]:
    """Write the triangles of a shape as PLY; returns its size, and the rotations that do not change a solid."""
    if mesh:
        vertices, faces = METRE * mesh.vertices, [(3, *corners) for corners in mesh.corners.tolist()]
    else:
        solid = build_mesh(shape)
        vertices = np.array(solid.vertices) * size / 2
        faces = [(3, face[0], *edge) for face in solid.faces for edge in pairwise(face[1:])]
    header = f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    header += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = (" ".join(map(str, row)) for row in (*vertices.round(6).tolist(), *faces))
    written.write(f"models/obj_{number_of(shape):06d}.ply", header + "\n".join(rows) + "\n")
    outermost = vertices[ConvexHull(vertices, qhull_options="QJ").vertices]  # QJ: a mesh may be flat
    # in blocks, because all distances of a ball's 18,000 vertices at once take a gigabyte, and nine times as long
    farthest = (cdist(outermost[i : i + 64], outermost[i:]).max() for i in range(0, len(outermost), 64))
    info: dict[str, Any] = {"diameter": float(max(farthest))}
    for axis, values in zip("xyz", vertices.T, strict=True):
        info |= {f"min_{axis}": float(values.min()), f"size_{axis}": float(np.ptp(values))}
    return info | ({} if mesh else _symmetries(shape, size))


def _symmetries(shape: str, size: np.ndarray) -> dict[str, Any]:
    kept = np.array([1.0, 1.0, 2.0]) if shape == "cylinder" else size
    turns = np.tile(np.eye(4), (24, 1, 1))  # those of a cube, of which the identity is the only one with trace 4
    turns[:, :3, :3] = Rotation.create_group("O").as_matrix().round()
    keeps = np.isclose(product(abs(turns[:, :3, :3]), kept), kept).all(axis=1) & (turns.trace(axis1=1, axis2=2) < 4)
    return {
        "symmetries_discrete": turns[keeps].reshape(-1, 16).tolist(),
        "symmetries_continuous": [{"axis": axis, "offset": [0, 0, 0]} for axis in ROUND_ABOUT[shape]],
    }

"""Small folders in the formats of BOP and COCO, written by hand as their documentation describes them.

Source: bop_toolkit, docs/bop_datasets_format.md;
https://cocodataset.org/#format-data.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

TURN = [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
BOP: dict[str, dict[str, Any]] = {
    "scene_gt.json": {
        "0": [
            {"cam_R_m2c": TURN, "cam_t_m2c": [-105.3577515, -117.52119142, 1014.8770132], "obj_id": 5},
            {"cam_R_m2c": TURN, "cam_t_m2c": [40.0, 20.0, 900.0], "obj_id": 12},
        ],
        "3": [
            {"cam_R_m2c": TURN, "cam_t_m2c": [10.0, 0.0, 1000.0], "obj_id": 5},
            {"cam_R_m2c": TURN, "cam_t_m2c": [0.0, 0.0, 1200.0], "obj_id": 5},
        ],
    },
    "scene_gt_info.json": {
        "0": [
            {"bbox_obj": [10, 12, 40, 50], "bbox_visib": [10, 12, 30, 50], "visib_fract": 0.75},
            {"bbox_obj": [-1, -1, -1, -1], "bbox_visib": [-1, -1, -1, -1], "visib_fract": 0.0},
        ],
        "3": [
            {"bbox_obj": [60, 30, 0, 9], "bbox_visib": [60, 30, 0, 9], "visib_fract": 1.0},
            {"bbox_obj": [20, 30, 19, 9], "bbox_visib": [20, 30, 19, 9], "visib_fract": 1.0},
        ],
    },
    "scene_camera.json": {
        "0": {"cam_K": [107.5, 0.0, 59.5, 0.0, 108.5, 44.5, 0.0, 0.0, 1.0], "depth_scale": 1.0},
        "3": {
            "cam_K": [107.5, 0.0, 60.0, 0.0, 108.5, 45.0, 0.0, 0.0, 1.0],
            "cam_R_w2c": TURN,
            "cam_t_w2c": [1.0, 2000.0, 3.0],
        },
    },
}
COCO: dict[str, Any] = {
    "camera": {"f": 110.0},
    "images": [
        {"id": 7, "file_name": "a.png", "width": 120, "height": 90},
        {"id": 9, "file_name": "b.png", "camera": {"fx": 100.0, "fy": 101.0, "cx": 61.0, "cy": 44.0}},
    ],
    "categories": [{"id": 1, "name": "cup", "supercategory": "kitchen"}, {"id": 4, "name": "spoon"}],
    "annotations": [
        {"id": 1, "image_id": 9, "category_id": 1, "bbox": [10.5, 20, 30, 40], "position": [0.1, 0, 2], "iscrowd": 0},
        {"id": 2, "image_id": 7, "category_id": 4, "bbox": [0, 0, 120, 90], "segmentation": [[0, 0, 9, 9, 0, 9]]},
        {"id": 3, "image_id": 7, "category_id": 4, "bbox": [0, 0, 120, 90], "iscrowd": 1},
    ],
}


def image(file: Path, size: tuple[int, int] = (120, 90)) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.zeros((size[1], size[0], 3), dtype=np.uint8)).save(file)


def write_bop(folder: Path) -> Path:
    """Scene 2: image 0 in PNG with an invisible object, image 3 in JPEG with a posed camera and an object twice."""
    image(folder / "000002" / "rgb" / "000000.png")
    image(folder / "000002" / "rgb" / "000003.jpg")
    for name, content in BOP.items():
        (folder / "000002" / name).write_text(json.dumps(content))
    return folder


def write_coco(folder: Path) -> Path:
    image(folder / "a.png")
    image(folder / "b.png")
    (folder.parent / "annotations").mkdir(exist_ok=True)
    (folder.parent / "annotations" / f"instances_{folder.name}.json").write_text(json.dumps(COCO))
    return folder


WRITERS: dict[str, Callable[[Path], Path]] = {"bop": write_bop, "coco": write_coco}

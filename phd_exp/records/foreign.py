"""Annotations in the formats of BOP and COCO, as the values of `DetectionLine`s.

    BOP      <folder>/000000/scene_gt.json, scene_gt_info.json, scene_camera.json, and rgb/000000.png or gray/; of
             several sensors scene_gt_SENSOR.json and so on, and rgb_SENSOR/, gray_SENSOR/ or SENSOR/; or of each
             image 000000.gt.json, 000000.gt_info.json, 000000.camera.json, and 000000.rgb.png
    COCO     <folder>/../annotations/instances_<name of the folder>.json, and the images in the folder; or one of
             the other `COCO_FILES`

COCO has no cameras and no positions: `camera`, of an image or at the top for all, has the keys f, or fx and fy, cx
and cy, and an annotation may have `position` [x, y, z]. BOP counts pixels from the centre of the first one, COCO and
a `DetectionLine` from its corner.

Source: bop_toolkit, docs/bop_datasets_format.md (scripts/calc_gt_info.py for the width of a box) and BlenderProc,
CameraUtility.py (the principal point); cocodataset.org/#format-data.
"""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import chain
from os.path import normpath
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from phd_exp.records.cameras import CORNER
from phd_exp.records.errors import DatasetError, listed, reading
from phd_exp.records.files import MB, read_plain
from phd_exp.records.images import FORMATS, decoding, pillow_warnings
from phd_exp.records.parsing import parse_json

Entry = tuple[str, str, dict[str, Any]]
"""A place for messages, the name of an object, and the values of its `DetectionLine`."""
METRE = 1000.0  # mm
LARGEST = 1000 * MB  # bytes of a file; the instances of COCO's training images have 450 MB
RULE = "see `Standard formats` in docs/guides/own_images.md"
COCO_FILES = {
    "../annotations/instances_{}.json": "",
    "../../annotations/instances_{}.json": "",  # CVAT
    "annotations/instances_default.json": "images/default",  # CVAT
    "_annotations.coco.json": "",  # Roboflow
    "labels.json": "data",  # FiftyOne
    "result.json": "",  # Label Studio
}
"""Annotations in COCO's format, relative to a folder whose name is {}, and the subfolder of their images."""
OF_BOP = ("scene_*.json", "*.gt.json", "*.camera.json", "*.gt_info.json")


def format_of(folder: Path) -> tuple[list[Path], Callable[[Path], Iterator[Entry]]] | None:
    """The annotation files of a folder and the reader of their format; None if it is neither."""
    if any(folder.glob("*/scene_gt*.json")) or any(folder.glob("*/*.gt.json")):
        listing = _targets(folder)
        found = [file for name in OF_BOP for file in folder.glob(f"*/{name}")]
        return sorted([*found, *([listing] if listing else [])]), _bop
    for name, subfolder in COCO_FILES.items():
        file = Path(normpath(folder.absolute() / name.format(folder.absolute().name)))
        if file.exists():
            return [file], partial(_coco, file, subfolder)
    return None


def expected_in(folder: Path) -> str:
    """What was looked for in a folder without annotations, and what is there."""
    if not folder.is_dir():
        return "no such folder"
    places = [folder.parent, *sorted(folder.glob("*/")), *sorted(folder.glob("*/*/"))]
    open_to_us = [place for place in places if os.access(place, os.X_OK)]  # others raise PermissionError
    if near := [str(place) for place in open_to_us if (place / "metadata.jsonl").exists() or format_of(place)]:
        return f"no annotations; expected one of the folders with annotations near it: {listed(near)}"
    coco = ", ".join(COCO_FILES).format(*[folder.absolute().name] * 2)
    names = sorted(f"{file.name}/" if file.is_dir() else file.name for file in folder.glob("*"))
    return (
        f"no annotations; found {listed(names) or 'nothing'}; expected metadata.jsonl, */scene_gt.json (BOP), or one "
        f"of {coco} (COCO); {RULE}; predict takes images alone too, with f=PIXELS or camera=FILE"
    )


def _bop(folder: Path) -> Iterator[Entry]:
    """The visible instances; positions are those of the models' origins, boxes contain what a detector could find.

    Of a folder `test*` with BOP's list of targets next to it, those alone.
    """
    wanted, n, n_visible = None, 0, 0
    if listing := _targets(folder):
        with reading(listing, RULE):
            wanted = {(one["scene_id"], one["im_id"], one["obj_id"]) for one in _read(listing)}
    for image, file, camera, items, infos in chain(_scenewise(folder), _imagewise(folder)):
        scene = file.relative_to(folder).parts[0]
        with reading(f"{folder / scene}, image {image}", RULE):
            pairs = list(zip(items, infos, strict=True))
        for number, (item, info) in enumerate(pairs):
            with reading(where := f"{folder / scene}, image {image}, object {number}", RULE):
                model, n = item["obj_id"], n + 1
                left, top, width, height = info["bbox_visib"]
                # invisible objects have the box -1, -1, -1, -1
                if width < 0 or (wanted is not None and (int(scene), image, model) not in wanted):
                    continue
                n_visible += 1
                values = {
                    "file_name": file.relative_to(folder).as_posix(),
                    "box": [left, top, left + width + 1, top + height + 1],  # a width is last minus first column
                    **dict(zip("xyz", (value / METRE for value in item["cam_t_m2c"]), strict=True)),
                    "visibility": info.get("visib_fract"),
                    "scale": item.get("scale"),  # written by `rendering/bop.py`
                }
                if "cam_R_w2c" in camera:
                    translation = [value / METRE for value in camera["cam_t_w2c"]]
                    values["pose"] = {"rotation": _quaternion(camera["cam_R_w2c"]), "translation": translation}
                    rank = sum(other["obj_id"] == model for other in items[:number])
                    values["scene"] = f"{scene}/{model}/{rank}"
                yield where, str(model), _pinhole(camera["cam_K"]) | values
    if n and not n_visible:
        here = f" and in {listing.name}" if listing else ""
        raise DatasetError(
            f"{folder}: {n} objects, none of them visible{here} (bbox_visib is -1, -1, -1, -1); {RULE}"
        )


def _targets(folder: Path) -> Path | None:
    file = folder.parent / "test_targets_bop19.json"
    return file if folder.name.startswith("test") and file.exists() else None


Pictured = tuple[int, Path, dict[str, Any], list[dict[str, Any]], Iterable[dict[str, Any]]]
"""Number and file of an image of BOP, its camera, and the `gt` and `gt_info` of its objects."""


def _scenewise(folder: Path) -> Iterator[Pictured]:
    for file in sorted(folder.glob("*/scene_gt*.json")):
        sensor = file.stem.removeprefix("scene_gt")
        if sensor.startswith("_info"):
            continue
        names = filter(None, (f"rgb{sensor}", sensor.removeprefix("_"), f"gray{sensor}"))
        folders = [file.with_name(name) for name in names]
        place = next((one for one in folders if one.exists()), folders[-1])
        calibrated, described = (file.with_name(f"scene_{name}{sensor}.json") for name in ("camera", "gt_info"))
        pictures = {picture.stem: picture for picture in sorted(place.glob("*.*"))}
        cameras, infos = _by_image(calibrated), _by_image(described) if described.exists() else None
        for image, items in _by_image(file).items():
            with reading(f"{file.parent}, image {image}", RULE):
                camera, picture = cameras[image], pictures[f"{image:06d}"]
                masks = file.with_name(f"mask_visib{sensor}") / picture.stem
                yield image, picture, camera, items, _of_masks(masks, len(items)) if infos is None else infos[image]


def _imagewise(folder: Path) -> Iterator[Pictured]:
    for file in sorted(folder.glob("*/*.gt.json")):
        stem = file.name.removesuffix(".gt.json")
        items, camera, known = (_read(file.with_name(f"{stem}.{name}.json")) for name in ("gt", "camera", "gt_info"))
        with reading(file, RULE):
            pictures = sorted([*file.parent.glob(f"{stem}.rgb.*"), *file.parent.glob(f"{stem}.gray.*")])
            yield int(stem.rpartition("_")[2]), pictures[0], camera, items, known


def _by_image(file: Path) -> dict[int, Any]:
    """The values by the number of the image, whose key may have zeros before it."""
    with reading(file, RULE):
        return {int(image): value for image, value in _read(file).items()}


def _of_masks(masks: Path, n: int) -> Iterator[dict[str, Any]]:
    """The boxes of n objects of an image, of the files of `mask_visib/`."""
    for mask in (Path(f"{masks}_{number:06d}.png") for number in range(n)):
        if not mask.exists():
            raise ValueError(f"expected scene_gt_info.json, which bop_toolkit's calc_gt_info.py writes, or {mask}")
        with decoding(mask), pillow_warnings(), Image.open(mask, formats=FORMATS) as image:
            left, top, right, bottom = image.getbbox() or (-1, -1, -1, -1)
        yield {"bbox_visib": [left, top, right - left - 1, bottom - top - 1]}


def _coco(file: Path, subfolder: str, folder: Path) -> Iterator[Entry]:
    """All annotations except crowds."""
    content = _read(file)
    with reading(file, RULE):
        if not isinstance(content, dict):
            raise ValueError("expected an object with images, annotations and categories; export it as COCO")
        images, categories = _by_id(content["images"]), _by_id(content["categories"])
        items = list(content["annotations"])
    for number, item in enumerate(items):
        with reading(where := f"{file}, annotation {number}", RULE):
            if _is_crowd(item):
                continue
            image = images[str(item["image_id"])]
            values = {name: image[name] for name in ("width", "height") if image.get(name)}
            values |= dict(zip("xyz", item["position"], strict=True)) if "position" in item else {}
            name = Path(subfolder, image["file_name"].replace("\\", "/"))
            values |= {"file_name": str(name), "box": edges(item["bbox"])}
            camera = image.get("camera") or content.get("camera")
            if camera is None:
                raise ValueError('no camera; add "camera": {"f": 900} in pixels, once or to each image')
            yield where, str(categories[str(item["category_id"])]["name"]), camera | values


def _by_id(items: Sequence[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """The items by their id as text, since some programs write it as such in one place and not in another."""
    found: dict[str, dict[str, Any]] = {}
    for item in items:
        if found.setdefault(str(item["id"]), item) is not item:
            raise ValueError(f"the id {item['id']} is given twice")
    return found


def _is_crowd(item: dict[str, Any]) -> bool:
    return bool(int(item.get("iscrowd") or 0))  # also of "0"


def boxes_in(file: Path, category: int | str | None = None) -> list[dict[str, Any]]:
    """The `box` (left, top, right, bottom, px), `score` and `category_id` of each of one image's COCO results,
    `[{"bbox": [...], ...}, ...]`, or of a whole file of COCO.

    Raises DatasetError if the file cannot be read, has boxes of several images, or none of the category.
    """
    images = boxes_of_images(file, category)
    if len(images) > 1:
        raise DatasetError(f"{file}: has boxes of several images; expected those of one; {RULE}")
    return next(iter(images.values()))


def boxes_of_images(file: Path, category: int | str | None = None) -> dict[str, list[dict[str, Any]]]:
    """The same for each `image_id`, as text; of images without a box of the category there is nothing.

    Raises DatasetError if the file cannot be read, or has no box of the category.
    """
    found: dict[str, list[dict[str, Any]]] = {}
    others = set()
    with reading(file, RULE):
        content = _read(file)
        items = list(content["annotations"] if isinstance(content, dict) else content)
    for number, item in enumerate(items):
        with reading(
            f"{file}, box {number}", f"expected [{{bbox: [x, y, width, height], category_id: ...}}]; {RULE}"
        ):
            if _is_crowd(item):
                continue
            if category is None or str(item["category_id"]) == str(category):
                given = {key: item[key] for key in ("score", "category_id") if key in item}
                found.setdefault(str(item.get("image_id")), []).append({"box": edges(item["bbox"]), **given})
            else:
                others.add(str(item["category_id"]))
    if not found:
        here = f"has category_id {listed(sorted(others))}" if others else "is empty"
        raise DatasetError(f"{file}: no box to predict: it {here}")
    return found


def edges(bbox: Sequence[float]) -> list[float]:
    """Left, top, right, bottom of COCO's box [x, y, width, height]. Raises ValueError unless it has four numbers."""
    x, y, width, height = map(float, bbox)
    return [x, y, x + width, y + height]


def _read(file: Path) -> Any:
    with reading(file, RULE):
        return parse_json(read_plain(file, LARGEST).decode("utf-8-sig"))


def _pinhole(K: Sequence[float]) -> dict[str, float]:
    """fx, fy, cx, cy, given the rows of K."""
    fx, skew, cx, zero, fy, cy, *last = K
    if [skew, zero, *last] != [0, 0, 0, 0, 1]:
        raise ValueError("expected a camera without skew: fx, 0, cx, 0, fy, cy, 0, 0, 1")
    return {"fx": fx, "fy": fy, "cx": cx + CORNER, "cy": cy + CORNER}


def _quaternion(rows: Sequence[float]) -> list[float]:
    """(w, x, y, z) of a rotation matrix."""
    from scipy.spatial.transform import Rotation  # imported slowly, and few data sets need it

    R = np.reshape(rows, (3, 3))
    # NaN is refused too, before scipy, which accepts it with a warning
    if not np.abs(R @ R.T - np.eye(3)).max() <= 1e-3:
        raise ValueError("cam_R_w2c: expected the rows of a rotation matrix")
    return [float(value) for value in Rotation.from_matrix(R).as_quat(scalar_first=True)]

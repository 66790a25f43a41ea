"""BOP and COCO as detections: conventions against the formats' own equations, and each broken in many ways."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from phd_exp.records.dataset import SPLITS
from phd_exp.records.detections import Detection
from phd_exp.records.errors import DatasetError, UserError
from phd_exp.records.foreign import boxes_in
from phd_exp.records.own_images import annotations, detections_in, fingerprint, observed
from tests.support.foreign import BOP, COCO, TURN, WRITERS, image


@pytest.fixture
def read(tmp_path: Path) -> Callable[..., list[Detection]]:
    """The detections of a folder in one of the formats."""

    def read(name: str, object_name: int | str | None = None) -> list[Detection]:
        if not (tmp_path / "test").exists():
            WRITERS[name](tmp_path / "test")
        return detections_in(tmp_path / "test", object_name=object_name)

    return read


def pixel(detection: Detection, width: int, height: int) -> tuple[float, float]:
    """Where the position projects to, from the corner of the image, px."""
    fx, fy, cx, cy = detection.focal_lengths_and_centre(width, height)
    x, y, z = detection.position
    return cx + fx * x / z, cy + fy * y / z


def test_bop_positions_project_as_its_equation_says(read: Callable, tmp_path: Path) -> None:
    """s p_i = K [R, t] p_m of the model's origin, p_i from the centre of a pixel; invisible objects are left out."""
    found = read("bop")
    pairs = [("0", 0), ("3", 0), ("3", 1)]
    for detection, (name, number) in zip(found, pairs, strict=True):
        t = np.array(BOP["scene_gt.json"][name][number]["cam_t_m2c"])
        np.testing.assert_allclose(np.array(detection.position) * 1000, t, rtol=1e-15)
        u, v, s = np.reshape(BOP["scene_camera.json"][name]["cam_K"], (3, 3)) @ t
        np.testing.assert_allclose(pixel(detection, 120, 90), (u / s + 0.5, v / s + 0.5), rtol=1e-12)
    assert [detection.file for detection in found] == [
        tmp_path / "test/000002/rgb" / name for name in ("000000.png", "000003.jpg", "000003.jpg")
    ]
    # the first and last column and row of the visible pixels, here with their edges
    assert [detection.line.box for detection in found] == [(10, 12, 41, 63), (60, 30, 61, 40), (20, 30, 40, 40)]
    assert [detection.line.visibility for detection in found] == [0.75, 1, 1]


def test_bop_cameras_with_poses_form_scenes_of_one_object_each(read: Callable) -> None:
    plain, first, second = read("bop")
    assert (plain.line.scene, plain.line.pose) == (None, None)
    scenes = observed([first, second])
    assert [scene.scene for scene in scenes] == ["000002/5/0", "000002/5/1"]
    (pose,) = scenes[0].poses
    w, x, y, z = pose.rotation
    np.testing.assert_allclose(Rotation.from_quat([x, y, z, w]).as_matrix().ravel(), TURN, atol=1e-15)
    assert pose.translation == (0.001, 2.0, 0.003)


def test_coco_boxes_cameras_and_positions(read: Callable) -> None:
    cup, spoon = read("coco")
    assert cup.box(120, 90) == (10.5, 20, 40.5, 60)
    assert cup.focal_lengths_and_centre(120, 90) == (100, 101, 61, 44)
    assert spoon.focal_lengths_and_centre(120, 90) == (110, 110, 60, 45)
    assert cup.position == (0.1, 0, 2)
    assert spoon.line.z is None


@pytest.mark.parametrize(
    ("annotations", "images", "folder"),
    [
        ("annotations/instances_val.json", "val", "val"),
        ("annotations/instances_default.json", "images/default", "images/default"),
        ("annotations/instances_default.json", "images/default", "."),
        ("val/_annotations.coco.json", "val", "val"),
        ("labels.json", "data", "."),
        ("result.json", "images", "."),
    ],
    ids=["COCO", "CVAT, its images", "CVAT", "Roboflow", "FiftyOne", "Label Studio"],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_coco_is_read_in_the_folders_of_other_programs(
    tmp_path: Path, annotations: str, images: str, folder: str, encoding: str
) -> None:
    content = json.loads(json.dumps(COCO))
    for item in content["images"]:
        image(tmp_path / images / item["file_name"])
        item["file_name"] = f"images\\{item['file_name']}" if annotations == "result.json" else item["file_name"]
    (tmp_path / annotations).parent.mkdir(exist_ok=True)
    (tmp_path / annotations).write_text(json.dumps(content), encoding)
    found = detections_in(tmp_path / folder)
    assert [detection.file for detection in found] == [tmp_path / images / name for name in ("b.png", "a.png")]


def test_coco_of_several_programs_means_the_same(tmp_path: Path) -> None:
    """Identifiers and crowds as text; sizes as text, as numbers, or none."""
    folder = WRITERS["coco"](tmp_path / "test")
    expected = [detection.line for detection in detections_in(folder)]
    content = json.loads(json.dumps(COCO))
    for item, crowd in zip(content["annotations"], ("0", False, "1"), strict=True):
        item |= {"image_id": str(item["image_id"]), "category_id": str(item["category_id"]), "iscrowd": crowd}
    content["images"][0] |= {"width": "120", "height": 90.0}
    content["images"][1] |= {"width": 0, "height": None}
    (tmp_path / "annotations/instances_test.json").write_text(json.dumps(content))
    assert [detection.line for detection in detections_in(folder)] == expected


@pytest.mark.parametrize(("width", "height"), [(90, 120), (121, 90), (1200, 900)])
def test_the_size_of_an_image_is_that_of_its_annotations(read: Callable, width: int, height: int) -> None:
    _, spoon = read("coco")
    assert spoon.focal_lengths_and_centre(120, 90)[0] == 110
    said = f"annotation 1: is for images of 120 x 90 pixels; this image has {width} x {height};"
    with pytest.raises(DatasetError, match=said):
        spoon.focal_lengths_and_centre(width, height)


@pytest.mark.parametrize(("sensor", "images"), [("cam1", "rgb_cam1"), ("gray2", "gray2"), ("xyz", "gray_xyz")])
def test_bop_of_several_sensors_is_read_as_each_of_them(tmp_path: Path, sensor: str, images: str) -> None:
    scene = WRITERS["bop"](tmp_path / "test") / "000002"
    plain = [detection.line for detection in detections_in(tmp_path / "test")]
    for file in scene.glob("scene_*.json"):
        file.rename(file.with_name(f"{file.stem}_{sensor}.json"))
    (scene / "rgb").rename(scene / images)
    found = [detection.line for detection in detections_in(tmp_path / "test")]
    assert [line.file_name for line in found] == [line.file_name.replace("/rgb/", f"/{images}/") for line in plain]
    assert [line.model_copy(update={"file_name": ""}) for line in found] == [
        line.model_copy(update={"file_name": ""}) for line in plain
    ]


def test_bop_of_other_programs_means_the_same(tmp_path: Path) -> None:
    """Keys with zeros, a file for each image, and boxes of masks instead of `scene_gt_info.json`."""
    scene = WRITERS["bop"](tmp_path / "test") / "000002"
    lines = [detection.line for detection in detections_in(tmp_path / "test")]
    for name, content in BOP.items():
        (scene / name).write_text(json.dumps({f"{int(key):06d}": value for key, value in content.items()}))
    assert [detection.line for detection in detections_in(tmp_path / "test")] == lines

    (scene / "scene_gt_info.json").unlink()
    for image_name, infos in BOP["scene_gt_info.json"].items():
        for number, info in enumerate(infos):
            left, top, width, height = info["bbox_visib"]
            pixels = np.zeros((90, 120), np.uint8)
            pixels[max(top, 0) : top + height + 1, max(left, 0) : left + width + 1] = 255 * (width >= 0)
            (scene / "mask_visib").mkdir(exist_ok=True)
            Image.fromarray(pixels).save(scene / f"mask_visib/{int(image_name):06d}_{number:06d}.png")
    unknown = [line.model_copy(update={"visibility": None}) for line in lines]
    assert [detection.line for detection in detections_in(tmp_path / "test")] == unknown

    single = tmp_path / "imagewise/000002"
    for picture in sorted((scene / "rgb").iterdir()):
        image(single / f"{picture.stem}.rgb{picture.suffix}")
        for name, content in BOP.items():
            kind = name.removeprefix("scene_")
            (single / f"{picture.stem}.{kind}").write_text(json.dumps(content[str(int(picture.stem))]))
    found = [detection.line for detection in detections_in(single.parent)]
    assert [line.file_name for line in found] == ["000002/000000.rgb.png"] + 2 * ["000002/000003.rgb.jpg"]
    assert [line.model_copy(update={"file_name": ""}) for line in found] == [
        line.model_copy(update={"file_name": ""}) for line in lines
    ]


def test_bop_without_anything_visible_says_so(tmp_path: Path) -> None:
    file = WRITERS["bop"](tmp_path / "test") / "000002/scene_gt_info.json"
    hidden = {image: [{"bbox_visib": [-1] * 4} for _ in infos] for image, infos in BOP[file.name].items()}
    file.write_text(json.dumps(hidden))
    with pytest.raises(DatasetError, match=r"test: 4 objects, none of them visible .bbox_visib is -1, -1, -1, -1."):
        detections_in(tmp_path / "test")


def test_targets_of_bop_are_those_of_a_test(tmp_path: Path) -> None:
    for split in ("test", "train"):
        WRITERS["bop"](tmp_path / split)
    target = {"scene_id": 2, "im_id": 3, "obj_id": 5, "inst_count": 2}
    (tmp_path / "test_targets_bop19.json").write_text(json.dumps([target]))
    files = [[one.file.name for one in detections_in(tmp_path / split)] for split in ("test", "train")]
    assert files == [2 * ["000003.jpg"], ["000000.png", *2 * ["000003.jpg"]]]


def test_a_folder_without_annotations_says_what_is_there_and_what_is_read(tmp_path: Path) -> None:
    folder = tmp_path / "voc"
    image(folder / "images" / "a.png")
    (folder / "a.xml").touch()
    with pytest.raises(DatasetError) as caught:
        detections_in(folder)
    assert str(caught.value).startswith(f"{folder}: no annotations; found a.xml, images/; expected metadata.jsonl, ")
    layouts = ("*/scene_gt.json (BOP)", "../annotations/instances_voc.json", "labels.json", "f=PIXELS")
    assert all(layout in str(caught.value) for layout in layouts)


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("given", [".", "deep", "deep/test/000002"])
def test_a_folder_near_annotations_names_theirs(tmp_path: Path, name: str, given: str) -> None:
    """The root of a data set in any format, or a single scene of BOP."""
    WRITERS[name](tmp_path / "deep" / "test")
    (tmp_path / given).mkdir(exist_ok=True)
    with pytest.raises(DatasetError, match=r"no annotations; expected one of the folders .*: \S*/deep/test$"):
        detections_in(tmp_path / given)


def test_results_are_the_boxes_of_one_image(tmp_path: Path) -> None:
    def boxes(*items: dict[str, Any], category: int | None = None) -> list[dict[str, Any]]:
        (file := tmp_path / "boxes.json").write_text(json.dumps(items))
        return boxes_in(file, category)

    one = {"image_id": 3, "category_id": 1, "bbox": [10, 20, 30.5, 40], "score": 0.9}
    two = one | {"category_id": 2, "bbox": [0, 0, 5, 5]}
    first = {"box": [10, 20, 40.5, 60], "score": 0.9, "category_id": 1}
    second = {"box": [0, 0, 5, 5], "score": 0.9, "category_id": 2}
    assert boxes(one, two) == [first, second]
    assert boxes(one, two, category=2) == [second]
    assert boxes(one, two | {"image_id": "3", "bbox": ["0", "0", "5", "5"]}, one | {"iscrowd": 1}) == boxes(one, two)
    (tmp_path / "coco.json").write_text(json.dumps({"images": [{"id": 3}], "annotations": [one, two]}), "utf-8-sig")
    assert boxes_in(tmp_path / "coco.json") == boxes(one, two)
    for items, category, line in [
        ((one, one | {"image_id": 4}), None, "has boxes of several images; expected those of one"),
        ((one, two), 3, "no box to predict: it has category_id 1, 2"),
        ((), None, "no box to predict: it is empty"),
        ((one, {"image_id": 3}), None, "box 1: cannot be read ..bbox. is missing"),
        ((one, one | {"bbox": [1, 2, 3]}), None, "box 1: cannot be read .not enough values"),
        ((1,), None, "box 0: cannot be read .* expected .*bbox: .x, y, width, height."),
        ((one, one | {"bbox": ["1", "2", "three", "4"]}), None, "box 1: cannot be read .could not convert"),
    ]:
        with pytest.raises(DatasetError, match=line):
            boxes(*items, category=category)


@pytest.mark.parametrize(
    ("name", "selected", "n", "names"), [("bop", 5, 3, "5, 12"), ("coco", "cup", 1, "cup, spoon")]
)
def test_an_object_is_selected(read: Callable, name: str, selected: int | str, n: int, names: str) -> None:
    assert len(read(name, selected)) == len(read(name, str(selected))) == n
    visible = names.removesuffix(", 12")
    with pytest.raises(DatasetError, match=rf"/test: no object 'x' here; expected one of {visible}$"):
        read(name, "x")


def test_a_metadata_jsonl_comes_first_and_has_no_objects(read: Callable, tmp_path: Path) -> None:
    read("bop")
    (tmp_path / "test" / "metadata.jsonl").write_text('{"file_name": "a.png", "f": 900}\n')
    assert [detection.line.f for detection in read("bop")] == [900]
    with pytest.raises(DatasetError, match=r"no object '5' here; expected no object=, since metadata\.jsonl names"):
        read("bop", 5)


@pytest.mark.parametrize("name", WRITERS)
def test_the_fingerprint_is_of_all_annotations(name: str, tmp_path: Path) -> None:
    folders = [tmp_path / split for split in SPLITS]
    for folder in folders:
        WRITERS[name](folder)
    prints = [fingerprint(*folders)]
    for file in (file for folder in folders for file in annotations(folder)[0]):
        file.write_text(file.read_text() + "\n")
        prints.append(fingerprint(*folders))
    assert len(set(prints)) == len(prints) == {"bop": 7, "coco": 3}[name]


def bop(file: str, change: Callable[[Any], Any]) -> tuple[str, Callable[[Path], Any]]:
    def spoil(folder: Path) -> None:
        content = json.loads(json.dumps(BOP[file]))
        change(content)
        (folder / "000002" / file).write_text(json.dumps(content))

    return "bop", spoil


def coco(change: Callable[[Any], Any]) -> tuple[str, Callable[[Path], Any]]:
    def spoil(folder: Path) -> None:
        content = json.loads(json.dumps(COCO))
        change(content)
        (folder.parent / "annotations" / "instances_test.json").write_text(json.dumps(content))

    return "coco", spoil


GT, INFO, CAMERA = "scene_gt.json", "scene_gt_info.json", "scene_camera.json"
SKEW = [107.5, 1.0, 60, 0, 108.5, 45, 0, 0, 1]
BAD = [
    (("bop", lambda folder: (folder / "000002" / GT).write_text("{")), "cannot be read"),
    (("bop", lambda folder: (folder / "000002" / CAMERA).unlink()), "No such file"),
    (bop(GT, lambda gt: gt["3"][0].pop("cam_t_m2c")), "image 3, object 0: cannot be read .'cam_t_m2c' is missing"),
    (bop(GT, lambda gt: gt["3"][0].update(cam_t_m2c=[0, 0, -900])), r"image 3, object 0: z: got -0\.9"),
    (bop(GT, lambda gt: gt.update({"3": 1})), "cannot be read"),
    (bop(CAMERA, lambda camera: camera.pop("3")), "000002, image 3: cannot be read .3 is missing"),
    (bop(INFO, lambda info: info["3"][0].update(visib_fract=2)), "visibility: got 2"),
    (bop(INFO, lambda info: info.pop("3")), "000002, image 3: cannot be read .3 is missing"),
    (bop(INFO, lambda info: info["3"].pop()), "000002, image 3: cannot be read .zip.. argument 2 is shorter"),
    (("bop", lambda folder: (folder / "000002" / INFO).unlink()), "expected scene_gt_info.json, which bop_toolkit"),
    (bop(CAMERA, lambda camera: camera["3"].update(cam_K=SKEW)), "camera without skew"),
    (bop(CAMERA, lambda camera: camera["3"].update(cam_R_w2c=[1, 0, 0, 0, 1, 0, 0, 0.1, 1])), "a rotation matrix"),
    (bop(CAMERA, lambda camera: camera["3"].update(cam_R_w2c=[np.nan, *TURN[1:]])), "a rotation matrix"),
    (("bop", lambda folder: (folder / "000002/rgb/000003.jpg").unlink()), "image 3: .*'000003' is missing"),
    (("coco", lambda folder: (folder.parent / "annotations/instances_test.json").write_text("[]")), "an object"),
    (coco(lambda content: content.pop("images")), "'images' is missing"),
    (coco(lambda content: content.pop("camera")), r"annotation 1: .*no camera; add \"camera\""),
    (coco(lambda content: content["camera"].update(k1=0.1)), "annotation 1: k1: a line describes no lens"),
    (coco(lambda content: content["annotations"][0].update(bbox=[1, 2, 0, 3])), "annotation 0: box=.* positive size"),
    (coco(lambda content: content["images"][1].update(id="7")), "the id 7 is given twice"),
    (coco(lambda content: content["images"][1].update(file_name="../b.png")), "is no file name .leaves"),
]  # fmt: skip


@pytest.mark.parametrize(("broken", "said"), BAD, ids=[f"{broken[0]}: {said[:40]}" for broken, said in BAD])
def test_a_broken_folder_is_one_line_that_names_the_file(
    read: Callable, tmp_path: Path, broken: tuple[str, Callable[[Path], Any]], said: str
) -> None:
    name, spoil = broken
    assert read(name)
    spoil(tmp_path / "test")
    with pytest.raises(UserError, match=said) as caught:
        read(name)
    assert str(caught.value).startswith(str(tmp_path))
    assert {"bop": "/000002", "coco": "/instances_test.json"}[name] in str(caught.value)
    assert "\n" not in str(caught.value)

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
from phd_exp.records.detections import Detection, DetectionLine
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


def lines(folder: Path, **changes: Any) -> list[DetectionLine]:
    """The lines of a folder, without the names of the images."""
    return [one.line.model_copy(update={"file_name": ""} | changes) for one in detections_in(folder)]


def test_bop_positions_project_as_its_equation_says(read: Callable, tmp_path: Path) -> None:
    """s p_i = K [R, t] p_m of the model's origin, p_i from the centre of a pixel; invisible objects are left out."""
    found = read("bop")
    for detection, (name, number) in zip(found, [("0", 0), ("3", 0), ("3", 1)], strict=True):
        t = np.array(BOP["scene_gt.json"][name][number]["cam_t_m2c"])
        np.testing.assert_allclose(np.array(detection.position) * 1000, t, rtol=1e-15)
        u, v, s = np.reshape(BOP["scene_camera.json"][name]["cam_K"], (3, 3)) @ t
        pixel = detection.optics(120, 90)[0] @ detection.position
        np.testing.assert_allclose(pixel[:2] / pixel[2], (u / s + 0.5, v / s + 0.5), rtol=1e-12)
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
    rotation = Rotation.from_quat(pose.rotation, scalar_first=True)
    np.testing.assert_allclose(rotation.as_matrix().ravel(), TURN, atol=1e-15)
    assert pose.translation == (0.001, 2.0, 0.003)


def test_coco_boxes_cameras_positions_and_sizes(read: Callable) -> None:
    cup, spoon = read("coco")
    assert cup.box(120, 90) == (10.5, 20, 40.5, 60)
    assert cup.optics(120, 90)[0].tolist() == [[100, 0, 61], [0, 101, 44], [0, 0, 1]]
    assert spoon.optics(120, 90)[0].tolist() == [[110, 0, 60], [0, 110, 45], [0, 0, 1]]
    assert (cup.position, spoon.line.z) == ((0.1, 0, 2), None)
    with pytest.raises(
        DatasetError, match="annotation 1: is for images of 120 x 90 pixels; this image has 121 x 90;"
    ):
        spoon.optics(121, 90)


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
def test_coco_of_other_programs_means_the_same(tmp_path: Path, annotations: str, images: str, folder: str) -> None:
    """In their folders, with a mark of the byte order; identifiers, crowds and sizes as text, numbers, or none."""
    expected = lines(WRITERS["coco"](tmp_path / "plain"))
    content = json.loads(json.dumps(COCO))
    for item, crowd in zip(content["annotations"], ("0", False, "1"), strict=True):
        item |= {"image_id": str(item["image_id"]), "category_id": str(item["category_id"]), "iscrowd": crowd}
    content["images"][0] |= {"width": "120", "height": 90.0}
    content["images"][1] |= {"width": 0, "height": None}
    for item in content["images"]:
        image(tmp_path / "there" / images / item["file_name"])
        item["file_name"] = f"images\\{item['file_name']}" if annotations == "result.json" else item["file_name"]
    file = tmp_path / "there" / annotations
    file.parent.mkdir(exist_ok=True)
    file.write_text(json.dumps(content), "utf-8-sig")
    found = detections_in(tmp_path / "there" / folder)
    assert [detection.file for detection in found] == [
        tmp_path / "there" / images / name for name in ("b.png", "a.png")
    ]
    assert lines(tmp_path / "there" / folder) == expected


@pytest.mark.parametrize(("sensor", "images"), [("cam1", "rgb_cam1"), ("gray2", "gray2"), ("xyz", "gray_xyz")])
def test_bop_of_several_sensors_is_read_as_each_of_them(tmp_path: Path, sensor: str, images: str) -> None:
    scene = WRITERS["bop"](tmp_path / "test") / "000002"
    plain = lines(tmp_path / "test")
    for file in scene.glob("scene_*.json"):
        file.rename(file.with_name(f"{file.stem}_{sensor}.json"))
    (scene / "rgb").rename(scene / images)
    assert {one.file.parent.name for one in detections_in(tmp_path / "test")} == {images}
    assert lines(tmp_path / "test") == plain


def test_bop_of_other_programs_means_the_same(tmp_path: Path) -> None:
    """Keys with zeros, a file for each image, and boxes of masks instead of `scene_gt_info.json`."""
    scene = WRITERS["bop"](tmp_path / "test") / "000002"
    plain = lines(tmp_path / "test")
    for name, content in BOP.items():
        (scene / name).write_text(json.dumps({f"{int(key):06d}": value for key, value in content.items()}))
    assert lines(tmp_path / "test") == plain

    (scene / "scene_gt_info.json").unlink()
    (scene / "mask_visib").mkdir()
    for image_name, infos in BOP["scene_gt_info.json"].items():
        for number, info in enumerate(infos):
            left, top, width, height = info["bbox_visib"]
            pixels = np.zeros((90, 120), np.uint8)
            pixels[max(top, 0) : top + height + 1, max(left, 0) : left + width + 1] = 255 * (width >= 0)
            Image.fromarray(pixels).save(scene / f"mask_visib/{int(image_name):06d}_{number:06d}.png")
    assert lines(tmp_path / "test") == [one.model_copy(update={"visibility": None}) for one in plain]

    single = tmp_path / "imagewise/000002"
    for picture in sorted((scene / "rgb").iterdir()):
        image(single / f"{picture.stem}.rgb{picture.suffix}")
        for name, content in BOP.items():
            file = single / f"{picture.stem}.{name.removeprefix('scene_')}"
            file.write_text(json.dumps(content[str(int(picture.stem))]))
    assert [one.file.name for one in detections_in(single.parent)] == ["000000.rgb.png"] + 2 * ["000003.rgb.jpg"]
    assert lines(single.parent) == plain


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
    with pytest.raises(
        DatasetError, match=r"voc: no annotations; found a.xml, images/; expected metadata.jsonl, "
    ) as no:
        detections_in(folder)
    layouts = ("*/scene_gt.json (BOP)", "../annotations/instances_voc.json", "labels.json", "f=PIXELS")
    assert all(layout in str(no.value) for layout in layouts)


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("given", [".", "deep", "deep/test/000002"])
def test_a_folder_near_annotations_names_theirs(tmp_path: Path, name: str, given: str) -> None:
    """The root of a data set in any format, or a single scene of BOP."""
    WRITERS[name](tmp_path / "deep" / "test")
    (tmp_path / given).mkdir(exist_ok=True)
    with pytest.raises(DatasetError, match=r"no annotations; expected one of the folders .*: \S*/deep/test$"):
        detections_in(tmp_path / given)


ONE = {"image_id": 3, "category_id": 1, "bbox": [10, 20, 30.5, 40], "score": 0.9}
TWO = ONE | {"category_id": 2, "bbox": [0, 0, 5, 5]}


def test_results_are_the_boxes_of_one_image(tmp_path: Path) -> None:
    file = tmp_path / "boxes.json"
    first = {"box": [10, 20, 40.5, 60], "score": 0.9, "category_id": 1}
    second = {"box": [0, 0, 5, 5], "score": 0.9, "category_id": 2}
    as_text = TWO | {"image_id": "3", "bbox": ["0", "0", "5", "5"]}
    whole = {"images": [{"id": 3}], "annotations": [ONE, TWO]}
    for content in ([ONE, TWO], [ONE, as_text, ONE | {"iscrowd": 1}], whole):
        file.write_text(json.dumps(content), "utf-8-sig")
        assert boxes_in(file) == [first, second]
        assert boxes_in(file, 2) == [second]


@pytest.mark.parametrize(
    ("items", "category", "said"),
    [
        ([ONE, ONE | {"image_id": 4}], None, "has boxes of several images; expected those of one"),
        ([ONE, TWO], 3, "no box to predict: it has category_id 1, 2"),
        ([], None, "no box to predict: it is empty"),
        ([ONE, {"image_id": 3}], None, "box 1: cannot be read ..bbox. is missing"),
        ([ONE, ONE | {"bbox": [1, 2, 3]}], None, "box 1: cannot be read .not enough values"),
        ([1], None, "box 0: cannot be read .* expected .*bbox: .x, y, width, height."),
    ],
)
def test_other_results_are_refused(tmp_path: Path, items: list[Any], category: int | None, said: str) -> None:
    (tmp_path / "boxes.json").write_text(json.dumps(items))
    with pytest.raises(DatasetError, match=said):
        boxes_in(tmp_path / "boxes.json", category)


@pytest.mark.parametrize(("name", "selected", "n", "names"), [("bop", 5, 3, "5"), ("coco", "cup", 1, "cup, spoon")])
def test_an_object_is_selected(read: Callable, name: str, selected: int | str, n: int, names: str) -> None:
    assert len(read(name, selected)) == len(read(name, str(selected))) == n
    with pytest.raises(DatasetError, match=rf"/test: no object 'x' here; expected one of {names}$"):
        read(name, "x")


def test_a_metadata_jsonl_comes_first_and_has_no_objects(read: Callable, tmp_path: Path) -> None:
    read("bop")
    (tmp_path / "test" / "metadata.jsonl").write_text('{"file_name": "a.png", "f": 900}\n')
    assert [detection.line.f for detection in read("bop")] == [900]
    with pytest.raises(DatasetError, match=r"no object '5' here; expected no object=, since metadata\.jsonl names"):
        read("bop", 5)


@pytest.mark.parametrize(("name", "n"), [("bop", 7), ("coco", 3)])
def test_the_fingerprint_is_of_all_annotations(name: str, n: int, tmp_path: Path) -> None:
    folders = [WRITERS[name](tmp_path / split) for split in SPLITS]
    prints = [fingerprint(*folders)]
    for file in (file for folder in folders for file in annotations(folder)[0]):
        file.write_text(file.read_text() + "\n")
        prints.append(fingerprint(*folders))
    assert len(set(prints)) == len(prints) == n


Spoil = Callable[[Any], Any]


def bop(change: Spoil, file: str = "scene_gt.json") -> tuple[str, str, Spoil]:
    return "bop", f"test/000002/{file}", change


def coco(change: Spoil) -> tuple[str, str, Spoil]:
    return "coco", "annotations/instances_test.json", change


INFO, CAMERA = "scene_gt_info.json", "scene_camera.json"
SKEW = [107.5, 1.0, 60, 0, 108.5, 45, 0, 0, 1]
HIDDEN = {"bbox_visib": [-1] * 4}
BAD: list[tuple[tuple[str, str, Spoil], str]] = [
    (bop(lambda gt: gt["3"][0].pop("cam_t_m2c")), "image 3, object 0: cannot be read .'cam_t_m2c' is missing"),
    (bop(lambda gt: gt["3"][0].update(cam_t_m2c=[0, 0, -900])), r"image 3, object 0: z: got -0\.9"),
    (bop(lambda gt: gt.update({"3": 1})), "cannot be read"),
    (bop(lambda gt: gt.update({"4": []})), "image 4: cannot be read .4 is missing"),
    (bop(lambda info: info["3"][0].update(visib_fract=2), INFO), "visibility: got 2"),
    (bop(lambda info: info["3"].pop(), INFO), "000002, image 3: cannot be read .zip.. argument 2 is shorter"),
    (bop(lambda info: info.update({"0": [HIDDEN] * 2, "3": [HIDDEN] * 2}), INFO), "4 objects, none of them visible"),
    (bop(lambda camera: camera["3"].update(cam_K=SKEW), CAMERA), "camera without skew"),
    (bop(lambda camera: camera["3"].update(cam_R_w2c=[np.nan, *TURN[1:]]), CAMERA), "a rotation matrix"),
    (coco(lambda content: content.pop("images")), "'images' is missing"),
    (coco(lambda content: content.pop("camera")), r"annotation 1: .*no camera; add \"camera\""),
    (coco(lambda content: content["camera"].update(k1=0.1)), "annotation 1: k1: a line describes no lens"),
    (coco(lambda content: content["annotations"][0].update(bbox=[1, 2, 0, 3])), "annotation 0: box=.* positive size"),
    (coco(lambda content: content["images"][1].update(id="7")), "the id 7 is given twice"),
    (coco(lambda content: content["images"][1].update(file_name="../b.png")), "b.png' is no file name .leaves"),
]


@pytest.mark.parametrize(("broken", "said"), BAD, ids=[f"{broken[0]}: {said[:40]}" for broken, said in BAD])
def test_a_broken_folder_is_one_line_that_names_it(
    read: Callable, tmp_path: Path, broken: tuple[str, str, Spoil], said: str
) -> None:
    name, file, change = broken
    assert read(name)
    content = json.loads((tmp_path / file).read_text())
    change(content)
    (tmp_path / file).write_text(json.dumps(content))
    with pytest.raises(UserError, match=said) as caught:
        read(name)
    assert str(caught.value).startswith(f"{tmp_path}/{'test' if name == 'bop' else file}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("gone", ["scene_camera.json", "scene_gt_info.json", "rgb/000003.jpg"])
def test_a_file_of_bop_that_is_gone_is_named(read: Callable, tmp_path: Path, gone: str) -> None:
    assert read("bop")
    (tmp_path / "test/000002" / gone).unlink()
    with pytest.raises(UserError, match=rf"test/000002.*({gone}|'000003' is missing)"):
        read("bop")

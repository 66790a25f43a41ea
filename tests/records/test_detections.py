"""The lines of a folder of own images: what they may leave out, and what is refused with file and line."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.detections import Detection, detections_of
from phd_exp.records.errors import DatasetError, UserError
from phd_exp.records.own_images import DetectionFolder, fingerprint

PLACED = {"x": 0.1, "y": -0.2, "z": 4.0}
GOOD: dict[str, Any] = {"file_name": "a.png", "f": 900.0} | PLACED


@pytest.fixture
def folder(tmp_path: Path) -> DetectionFolder:
    (tmp_path / "photos" / "train").mkdir(parents=True)
    return DetectionFolder(tmp_path / "photos")


@pytest.fixture
def read(folder: DetectionFolder) -> Callable[..., list[Detection]]:
    """The detections of a metadata.jsonl of these lines."""

    def read(*lines: Any, n: int | None = None) -> list[Detection]:
        text = "".join((line if isinstance(line, str) else json.dumps(line)) + "\n" for line in lines)
        (folder.root / "train/metadata.jsonl").write_text(text)
        return folder.detections("train", n)

    return read


def test_a_name_that_is_not_utf8_is_written_in_text() -> None:
    (detection,) = detections_of([Path(os.fsdecode(b"b\xff.png"))], {"f": 900.0})
    assert detection.line.file_name == "b\\xff.png"


def test_what_is_said_stands_and_what_is_left_out_follows_from_the_image(
    read: Callable, folder: DetectionFolder
) -> None:
    camera = {"fx": 800, "fy": 810.5, "cx": 0, "cy": -3.5, "box": [1, 2, 3.5, 4]}
    plain, full = read(GOOD, {"file_name": "b/c.jpg"} | camera | PLACED)
    assert plain.optics(640, 481)[0].tolist() == [[900, 0, 320], [0, 900, 240.5], [0, 0, 1]]
    assert (plain.box(640, 481), plain.position) == ((0, 0, 640, 481), (0.1, -0.2, 4))
    assert full.optics(640, 480)[0].tolist() == [[800, 0, 0], [0, 810.5, -3.5], [0, 0, 1]]
    assert (full.box(640, 480), full.file) == ((1, 2, 3.5, 4), folder.root / "train" / "b" / "c.jpg")


def test_the_lines_of_a_rendered_data_set_are_detections(dataset: DatasetFolder) -> None:
    expected = [((one.x, one.y, one.z), one.f, one.scale) for one in dataset.records("train")]
    detections = DetectionFolder(dataset.root).detections("train")
    assert [(one.position, one.line.f, one.line.scale) for one in detections] == expected


NO_F = {"file_name": "a.png"} | PLACED
BAD: list[tuple[Any, str]] = [
    ({"f": 900}, "file_name: missing"),
    (GOOD | {"fx": 900, "fy": 900}, "expected either f, or fx and fy"),
    (NO_F | {"fx": 900}, "fx is given alone; expected all of fx, fy"),
    (NO_F | {"camera": "c.yaml", "cx": 3, "cy": 4}, "or camera (a file) alone"),
    (NO_F | {"camera": "../c.yaml"}, "camera='../c.yaml' is no file name (leaves"),
    (GOOD | {"z": 0}, "z: got 0; expected to be greater than 0"),
    (
        GOOD | {"x": 0, "y": 0, "z": 0.00085},
        "got a position 0.00085 m from the camera; expected metres, and at least",
    ),
    (GOOD | {"f": True}, "f: got True; expected a valid number"),
    (GOOD | {"box": [3, 0, 3, 5]}, "expected [left, top, right, bottom] of positive size"),
    (GOOD | {"box": [0, 9, 3]}, "box.3: missing"),
    (GOOD | {"bx": [0, 0, 3, 5]}, "bx: unknown key, did you mean 'box'?"),
    (GOOD | {"k1": 0.1}, "k1: a line describes no lens; expected camera, a calibration file"),
    ("[1, 2]", "expected"),
    (GOOD | {"file_name": "b/../../a.png"}, "leaves"),
    (GOOD | {"file_name": "/etc/passwd"}, "leaves"),
    (GOOD | {"file_name": ""}, "file_name: got ''"),
    *((GOOD | {"cy": 0, key: 1e300}, f"{key}: got 1e+300") for key in ("cx", "z")),
]


@pytest.mark.parametrize(("line", "said"), BAD, ids=[str(said)[:40] for _, said in BAD])
def test_a_bad_line_is_one_line_that_names_it(read: Callable, folder: DetectionFolder, line: Any, said: str) -> None:
    with pytest.raises(UserError) as caught:
        read(GOOD, "", line)
    assert str(caught.value).startswith(f"{folder.root / 'train/metadata.jsonl'}, line 3: ")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("absolute", [True, False])
def test_no_link_leaves_the_folder(read: Callable, folder: DetectionFolder, tmp_path: Path, absolute: bool) -> None:
    (tmp_path / "secret.png").touch()
    (folder.root / "train" / "inside.png").touch()
    target = tmp_path / "secret.png" if absolute else Path("../../secret.png")
    os.symlink(target, folder.root / "train" / "out.png")
    os.symlink("inside.png", folder.root / "train" / "in.png")
    os.symlink(tmp_path, folder.root / "train" / "up")
    assert len(read(GOOD | {"file_name": "in.png"})) == 1
    os.symlink(folder.root, tmp_path / "link")
    assert len(DetectionFolder(tmp_path / "link").detections("train")) == 1
    for name in ("out.png", "up/secret.png"):
        with pytest.raises(DatasetError, match="leaves"):
            read(GOOD | {"file_name": name})


def test_a_box_may_reach_beyond_the_image_but_not_without_end_nor_lie_beside_it(read: Callable) -> None:
    beside = [(640, 0, 700, 10), (-9, 0, 0, 10), (0, 480, 5, 500), (0, -7, 5, 0)]
    boxes = [(-600, -100, 1200, 500), (-600, -100, 1400, 500), *beside, (0.1, 0.1, 0.4, 0.5), (0.9, 0.9, 1.4, 1.3)]
    inside, *refused = read(*(GOOD | {"box": box} for box in boxes))
    assert inside.box(640, 480) == (-600, -100, 1200, 500)
    reasons = ["more than 3 times as large", *["lies outside the image"] * 4, *["in units of the image"] * 2]
    for detection, reason in zip(refused, reasons, strict=True):
        with pytest.raises(DatasetError, match=rf"line \d: box=.* {reason}.* 640 x 480 pixels"):
            detection.box(640, 480)


def test_blank_lines_count_and_a_number_takes_the_first(read: Callable, folder: DetectionFolder) -> None:
    detections = read(GOOD, "", "  ", GOOD, "not read at all", n=2)
    assert [detection.where[-6:] for detection in detections] == ["line 1", "line 4"]
    with pytest.raises(DatasetError, match=r"3 detections asked for \(data.n_train\), 2 found"):
        read(GOOD, GOOD, n=3)
    with pytest.raises(DatasetError, match=r"metadata\.jsonl: some detections asked for .*, 0 found"):
        read("")
    with pytest.raises(DatasetError, match=r"photos/test: no such folder"):
        folder.detections("test")


def test_the_fingerprint_is_of_both_splits_and_of_camera_files(read: Callable, folder: DetectionFolder) -> None:
    read(GOOD)
    folders = [folder.root / "train", folder.root / "test"]
    folders[1].mkdir()
    (folders[1] / "metadata.jsonl").write_text('{"file_name": "a.png", "camera": "camera.yaml"}\n')
    (folders[1] / "camera.yaml").touch()
    seen = [fingerprint(*folders)]
    for name in ("train/metadata.jsonl", "test/metadata.jsonl", "test/camera.yaml"):
        with open(folder.root / name, "a") as stream:
            stream.write("\n")
        seen.append(fingerprint(*folders))
    assert len(set(seen)) == 4

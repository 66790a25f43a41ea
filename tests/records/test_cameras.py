"""Camera files of ROS and OpenCV: what they hold, and one line for a broken one."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from phd_exp.records.cameras import Calibration, read_camera
from phd_exp.records.detections import detection_of
from phd_exp.records.errors import DatasetError

MATRIX = [900.0, 0.0, 319.5, 0.0, 910.0, 239.5, 0.0, 0.0, 1.0]
COEFFICIENTS = [-0.3, 0.1, 0.001, -0.002, 0.0]


def ros(**changes: Any) -> dict[str, Any]:
    """A `camera_info` as ROS's calibrator writes it."""
    values = {
        "image_width": 640,
        "image_height": 480,
        "camera_name": "narrow_stereo",
        "camera_matrix": {"rows": 3, "cols": 3, "data": MATRIX},
        "distortion_model": "plumb_bob",
        "distortion_coefficients": {"rows": 1, "cols": 5, "data": COEFFICIENTS},
        "rectification_matrix": {"rows": 3, "cols": 3, "data": [1, 0, 0, 0, 1, 0, 0, 0, 1]},
    } | changes
    return {key: value for key, value in values.items() if value is not None}


def opencv(coefficients: str, more: str = "", tag: str = "matrix", sizes: str = "rows: 5\n   cols: 1") -> str:
    """A `FileStorage` as OpenCV 3, 4 and 5 write it."""
    return (
        f"%YAML:1.0\n---\n{more}camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
        "   data: [ 900., 0., 3.1950000000000000e+02, 0., 910., 239.5, 0., 0.,\n       1. ]\n"
        f"distortion_coefficients: !!opencv-{tag}\n   {sizes}\n   dt: d\n   data: [ {coefficients} ]\n"
    )


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "camera.yaml"


def read(file: Path, content: Any) -> Calibration:
    file.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return read_camera(file)


FIVE = "-0.3, 0.1, 1.0000000000000000e-03, -2.0e-03, 0."
MESSAGE = {"width": 640, "height": 480, "distortion_model": "plumb_bob", "D": COEFFICIENTS, "K": MATRIX}
SAME = [
    ros(),
    ros(distortion_coefficients={"rows": 1, "cols": 5, "data": ["-3e-1", "1e-1", "1e-03", "-2e-03", 0]}),
    MESSAGE,
    opencv(FIVE, "image_width: 640\nimage_height: 480\n"),
    opencv(FIVE, "image_width: 640\nimage_height: 480\n", "nd-matrix", "sizes: [ 5 ]").replace(":1.0", " 1.2"),
]


@pytest.mark.parametrize("content", SAME, ids=["ROS", "yaml-cpp", "message", "OpenCV 4", "OpenCV 5"])
def test_all_writers_are_read_alike(file: Path, content: Any) -> None:
    camera = read(file, content)
    assert (camera.width, camera.height, camera.model) == (640, 480, "plumb_bob")
    np.testing.assert_allclose(camera.K, MATRIX)
    np.testing.assert_allclose(camera.D, COEFFICIENTS)


def test_pixels_count_from_the_corner_and_the_size_must_be_that_of_the_image(file: Path) -> None:
    read(file, ros())
    detection = detection_of(Path("photo.jpg"), {"camera": str(file)})
    assert detection.focal_lengths_and_centre(640, 480) == (900, 910, 320, 240)
    with pytest.raises(DatasetError, match=r"photo\.jpg: camera=.*: is for images of 640 x 480 .* has 320 x 240"):
        detection.focal_lengths_and_centre(320, 240)
    read(file, opencv(FIVE))  # names no size
    detection = detection_of(Path("photo.jpg"), {"camera": str(file)})
    assert detection.focal_lengths_and_centre(320, 240) == (900, 910, 320, 240)


def test_a_file_that_opencv_writes_now(file: Path) -> None:
    cv2 = pytest.importorskip("cv2", reason="OpenCV, the oracle of lenses, is not installed")
    for coefficients in (np.array(COEFFICIENTS), np.array(COEFFICIENTS)[None], np.array(COEFFICIENTS)[:, None]):
        storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
        storage.write("camera_matrix", np.array(MATRIX).reshape(3, 3))
        storage.write("distortion_coefficients", coefficients)
        storage.release()
        camera = read_camera(file)
        assert [*camera.K, *camera.D] == MATRIX + COEFFICIENTS


@pytest.mark.parametrize(
    ("coefficients", "more", "model"),
    [
        (4, "", "plumb_bob"),
        (8, "", "rational_polynomial"),
        (14, "", "rational_polynomial"),
        (4, "fisheye_model: 1\n", "equidistant"),
        (4, "distortion_model: equidistant\n", "equidistant"),
    ],
)
def test_the_model_of_a_file_of_opencv(file: Path, coefficients: int, more: str, model: str) -> None:
    numbers = ", ".join(["0.01"] * min(coefficients, 8) + ["0."] * (coefficients - 8))
    assert read(file, opencv(numbers, more, sizes=f"rows: 1\n   cols: {coefficients}")).model == model


def matrix(data: list[Any], rows: int = 3, cols: int = 3) -> dict[str, Any]:
    return {"rows": rows, "cols": cols, "data": data}


BAD: list[tuple[Any, str]] = [
    (ros(camera_matrix=None), "camera_matrix: Field required"),
    (ros(distortion_coefficients=None), "distortion_coefficients: Field required"),
    (ros(camera_matrix=matrix(MATRIX[:8])), "camera_matrix: got [900.0"),
    (ros(camera_matrix=matrix(MATRIX[:6], 2, 3)), "as many numbers in data as rows x cols; rows and cols are [2, 3]"),
    (ros(camera_matrix=matrix([0.9, *MATRIX[1:4], 0.001, *MATRIX[5:]])), "expected [fx, 0, cx, 0, fy"),
    (ros(camera_matrix=matrix([900, 2, *MATRIX[2:]])), "expected [fx, 0, cx, 0, fy"),
    (ros(camera_matrix=matrix([float("nan"), *MATRIX[1:]])), "camera_matrix.0: got nan; expected"),
    (ros(camera_matrix="wide"), "camera_matrix: got 'wide'; expected a valid tuple"),
    (ros(distortion_model="thin_plate"), "distortion_model: got 'thin_plate'; expected to be 'plumb_bob', 'rational"),
    (
        ros(distortion_model="equidistant"),
        "distortion_coefficients: got [-0.3, 0.1, 0.001, -0.002, 0.0]; expected 4 for",
    ),
    (ros(distortion_coefficients=matrix([0.1] * 12, 1, 12), distortion_model="rational_polynomial"), "no thin prism"),
    (ros(image_width=0), "image_width: got 0; expected to be greater than 0"),
    ({"K": MATRIX, "D": COEFFICIENTS[:4]}, "distortion_model: got None; expected to be 'plumb_bob'"),
    ("a: [1", "while parsing"),
    ("just words", "expected a valid dictionary"),
    ("", "expected a valid dictionary"),
    ("a: !!python/object:os.system {}", "could not determine a constructor"),
]


@pytest.mark.parametrize(("content", "said"), BAD, ids=[said[:40] for _, said in BAD])
def test_a_broken_file_is_one_line_that_names_it(file: Path, content: Any, said: str) -> None:
    with pytest.raises(DatasetError) as caught:
        read(file, content)
    assert str(caught.value).startswith(f"{file}: ")
    assert said in str(caught.value)
    assert str(caught.value).endswith("expected YAML of ROS (camera_info) or OpenCV")
    assert "\n" not in str(caught.value)


def test_no_file_and_no_text_are_one_line_each(file: Path) -> None:
    with pytest.raises(DatasetError, match=r"camera\.yaml: No such file or directory; expected YAML"):
        read_camera(file)
    file.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DatasetError, match=r"camera\.yaml: 'utf-8' codec can't decode"):
        read_camera(file)

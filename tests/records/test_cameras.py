"""Camera files of many tools: read as OpenCV reads the same camera, or one line with what was found and expected."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from phd_exp.geometry import Lens
from phd_exp.records.cameras import Calibration, read_camera
from phd_exp.records.detections import detections_of
from phd_exp.records.errors import DatasetError
from tests.support.opencv import HALF, projected

MATRIX = [400.5, 0.0, 319.5, 0.0, 401.2, 239.5, 0.0, 0.0, 1.0]
FOUR = [-0.28, 0.07, 0.0005, -0.0003]
FIVE = [*FOUR, 0.01]
EIGHT = [0.19, -0.018, -0.0006, 0.00005, -0.0002, 0.54, -0.028, 0.001]
FISHEYE = [-0.03, 0.004, -0.002, 0.0003]


def matrix(data: list[Any], rows: int = 3, cols: int = 3) -> dict[str, Any]:
    return {"rows": rows, "cols": cols, "data": data}


def ros(**changes: Any) -> dict[str, Any]:
    """A `camera_info` as ROS's calibrator writes it."""
    values = {
        "image_width": 640,
        "image_height": 480,
        "camera_name": "narrow_stereo",
        "camera_matrix": matrix(MATRIX),
        "distortion_model": "plumb_bob",
        "distortion_coefficients": matrix(FIVE, 1, 5),
        "rectification_matrix": matrix([1, 0, 0, 0, 1, 0, 0, 0, 1]),
        "projection_matrix": matrix([380.0, 0, 320, 0, 0, 380, 240, 0, 0, 0, 1, 0], 3, 4),
    } | changes
    return {key: value for key, value in values.items() if value is not None}


def ros_with(model: str | None, D: list[Any], **changes: Any) -> dict[str, Any]:
    """The same with another lens."""
    return ros(distortion_model=model, distortion_coefficients=matrix(D, 1, len(D)), **changes)


def message(D: list[float], model: str, lower: bool = False) -> str:
    """A message of the topic `camera_info`, as `rostopic echo` and `ros2 topic echo` print it."""
    values = {
        "header": {"stamp": {"secs": 1, "nsecs": 2}, "frame_id": "camera"},
        **{"height": 480, "width": 640, "distortion_model": model},
        **{"D": D, "K": MATRIX, "R": [*MATRIX], "P": [1.0] * 12},
        "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
    }
    return yaml.safe_dump({key.lower() if lower else key: value for key, value in values.items()}) + "---\n"


def opencv(more: str = "", names: str = "camera_matrix distortion_coefficients", D: Any = FIVE, **kind: str) -> str:
    """A `FileStorage` as OpenCV 3, 4 and 5 write it."""
    tag, sizes = kind.get("tag", "matrix"), kind.get("sizes", f"rows: {len(D)}\n   cols: 1")
    K_name, D_name = names.split()
    return (
        f"%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\n{more}"
        f"{K_name}: !!opencv-matrix\n   rows: 3\n   cols: 3\n"
        "   dt: d\n   data: [ 400.5, 0., 3.1950000000000000e+02, 0., 401.2, 239.5, 0., 0.,\n       1. ]\n"
        f"{D_name}: !!opencv-{tag}\n   {sizes}\n   dt: d\n   data: {D}\n"
        'image_points: !!opencv-matrix\n   rows: 1\n   cols: 2\n   dt: "2f"\n   data: [ 1., 2., 3., 4. ]\n'
    )


def xml(D: list[float]) -> str:
    parts = [("camera_matrix", 3, 3, MATRIX), ("distortion_coefficients", len(D), 1, D)]
    matrices = "".join(
        f'<{name} type_id="opencv-matrix">\n  <rows>{rows}</rows>\n  <cols>{cols}</cols>\n  <dt>d</dt>\n'
        f"  <data>\n    {' '.join(map(str, data))}</data></{name}>\n"
        for name, rows, cols, data in parts
    )
    sizes = "<!-- px --><image_width>640</image_width>\n<image_height>480</image_height>\n"
    return f'<?xml version="1.0"?>\n<opencv_storage>\n{sizes}{matrices}</opencv_storage>\n'


def ini(D: list[float]) -> str:
    rows = "\n".join(" ".join(map(str, MATRIX[row : row + 3])) for row in (0, 3, 6))
    return (
        f"# oST version 5.0 parameters\n\n\n[image]\n\nwidth\n640\n\nheight\n480\n\n[cam/left]\n\ncamera matrix\n"
        f"{rows}\n\ndistortion\n{' '.join(map(str, D))}\n\nrectification\n1 0 0\n0 1 0\n0 0 1\n"
    )


def kalibr(D: list[float], model: str) -> dict[str, Any]:
    camera = {"camera_model": "pinhole", "distortion_coeffs": D, "distortion_model": model, "cam_overlaps": []}
    return {"cam0": camera | {"intrinsics": [400.5, 401.2, 319.5, 239.5], "resolution": [640, 480], "rostopic": "/a"}}


def anipose(D: list[float], more: str = "") -> str:
    rows = str(ROWS).replace("]", ",]")
    lens = f"size = [ 640, 480,]\nmatrix = {rows}\ndistortions = {D}\n{more}rotation = [ 0.1, 0.2, 0.3,]\n"
    return f'[cam_0]\nname = "A"\n{lens}translation = [ -17.68, 8.876, -34.37,]\n[metadata]\nadjusted = false\n'


def named(names: str, values: list[float]) -> dict[str, float]:
    return dict(zip(names.split(), values, strict=True))


F = named("fx fy cx cy", [400.5, 401.2, 319.5, 239.5])
CORNER = named("fl_x fl_y cx cy w h", [400.5, 401.2, 320.0, 240.0, 640, 480])
BROWN, RATIONAL, KB = "plumb_bob", "rational_polynomial", "equidistant"
FIRST = "k1 k2 p1 p2"
ROWS = [MATRIX[:3], MATRIX[3:6], MATRIX[6:]]
NONE = [0.0] * 4
SAME: dict[str, tuple[Any, str, list[float]]] = {
    "ROS": (ros(), BROWN, FIVE),
    "ROS, yaml-cpp": (ros_with(BROWN, [*map("{:e}".format, FIVE)]), BROWN, FIVE),
    "ROS, rational": (ros_with(RATIONAL, EIGHT), RATIONAL, EIGHT),
    "ROS, fisheye": (ros_with(KB, FISHEYE), KB, FISHEYE),
    "ROS, five of a fisheye": (ros_with(KB, [*FISHEYE, 0]), KB, FISHEYE),
    "ROS, camera_model": (ros_with(None, FISHEYE, camera_model=KB), KB, FISHEYE),
    "ROS, none": (ros_with("none", []), BROWN, NONE),
    "ROS, no name": (ros_with("", [0.0] * 7), BROWN, NONE),
    "ROS, no coefficients": (ros(distortion_coefficients=matrix([], 0, 0)), BROWN, NONE),
    "rostopic echo": (message(FIVE, BROWN), BROWN, FIVE),
    "rostopic echo, two messages": (2 * message(FIVE, BROWN), BROWN, FIVE),
    "ros2 topic echo": (message(EIGHT, RATIONAL, lower=True), RATIONAL, EIGHT),
    "ROS, INI": (ini(FIVE), BROWN, FIVE),
    "ROS, INI, rational": (ini(EIGHT), RATIONAL, EIGHT),
    "OpenCV": (opencv(), BROWN, FIVE),
    "OpenCV 5": (opencv(tag="nd-matrix", sizes="sizes: [ 5 ]").replace(":1.0", " 1.2"), BROWN, FIVE),
    "OpenCV, four with a flag": (opencv("fisheye_model: 0\n", D=FOUR), BROWN, FOUR),
    "OpenCV, eight": (opencv(D=EIGHT), RATIONAL, EIGHT),
    "OpenCV, fourteen": (opencv(D=[*EIGHT, *[0] * 6]), RATIONAL, EIGHT),
    "OpenCV, fisheye": (opencv("fisheye_model: 1\n", D=FISHEYE), KB, FISHEYE),
    "OpenCV, three zeros": (opencv(D=[0, 0, 0]), BROWN, NONE),
    "OpenCV, cameraMatrix": (opencv(names="cameraMatrix distCoeffs"), BROWN, FIVE),
    "OpenCV, K": (opencv("distortion_model: radtan\n", names="K D", D=FOUR), BROWN, FOUR),
    "OpenCV, fisheye by name": (opencv("distortion_model: fisheye\n", names="K D", D=FISHEYE), KB, FISHEYE),
    "OpenCV, XML": (xml(FIVE), BROWN, FIVE),
    "OpenCV, interactive-calibration": (
        opencv("cameraResolution: [640, 480]\ndist_coeffs_std_dev: [0.1, 0.2]\n", "cameraMatrix dist_coeffs"),
        BROWN,
        FIVE,
    ),
    "Kalibr": (kalibr(FOUR, "radtan"), BROWN, FOUR),
    "Kalibr, fisheye": (kalibr(FISHEYE, "equidistant"), KB, FISHEYE),
    "Kalibr, none": (kalibr([], "none"), BROWN, NONE),
    "Anipose": (anipose(FIVE), BROWN, FIVE),
    "Anipose, fisheye": (anipose(FISHEYE, "fisheye = true\n"), KB, FISHEYE),
    "cam_K.txt": ("\n".join("\t".join(map("{:.18e}".format, row)) + "\t" for row in ROWS) + "\n", BROWN, NONE),
    "cam_K.txt, commas": ("\n".join(", ".join(map(str, row)) for row in ROWS), BROWN, NONE),
    "fx fy cx cy": ("  400.5 401.2 319.5 239.5\n", BROWN, NONE),
    "fx fy cx cy, DROID-SLAM": (" ".join(map(str, [400.5, 401.2, 319.5, 239.5, *FIVE])), BROWN, FIVE),
    "JSON of NumPy, other things of these names": ({"K": ROWS, "roi": 3, "k": 5, "d": 2}, BROWN, NONE),
    "JSON of NumPy, quoted": ({"K": str(ROWS), "D": str([FIVE])}, BROWN, FIVE),
    "JSON of NumPy": ({"K": ROWS, "dist": [FIVE]}, BROWN, FIVE),
    "JSON of NumPy, camera_matrix": (
        {"camera_matrix": ROWS, "dist_coeff": [FIVE], "image_size": [640, 480]},
        BROWN,
        FIVE,
    ),
    "BOP": (F | {"depth_scale": 0.1, "width": 640, "height": 480}, BROWN, NONE),
    "BOP, scene": ({"0": {"cam_K": MATRIX, "depth_scale": 1.0}, "7": {"cam_K": MATRIX}}, BROWN, NONE),
    "COLMAP": ("# Camera list\n1 OPENCV 640 480 400.5 401.2 320 240 -0.28 0.07 5e-4 -3e-4\n", BROWN, FOUR),
    "COLMAP, rational": ("1 FULL_OPENCV 640 480 400.5 401.2 320 240 " + " ".join(map(str, EIGHT)), RATIONAL, EIGHT),
    "COLMAP, fisheye": ("1 OPENCV_FISHEYE 640 480 400.5 401.2 320 240 -0.03 0.004 -0.002 0.0003\n", KB, FISHEYE),
    "COLMAP, pinhole": ("1 PINHOLE 640 480 400.5 401.2 320 240\n2 PINHOLE 640 480 400.5 401.2 320 240", BROWN, NONE),
    "nerfstudio": (
        CORNER | named(FIRST, FOUR) | {"camera_model": "OPENCV", "frames": [{"file_path": "a.png"}]},
        BROWN,
        FOUR,
    ),
    "nerfstudio, frames": ({"frames": [CORNER | named(FIRST, FOUR)] * 2}, BROWN, FOUR),
    "nerfstudio, fisheye": (CORNER | named("k1 k2 k3 k4", FISHEYE) | {"camera_model": "OPENCV_FISHEYE"}, KB, FISHEYE),
    "instant-ngp": (CORNER | named(FIRST + " k3 k4", [*FOUR, 0, 0]) | {"is_fisheye": False}, BROWN, FOUR),
}
"""Format -> one camera in it, and the model and coefficients that OpenCV needs for it."""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "camera.yaml"


def read(file: Path, content: Any, encoding: str = "utf-8") -> Calibration:
    file.write_text(content if isinstance(content, str) else json.dumps(content), encoding)
    return read_camera(file)


@pytest.mark.parametrize("name", SAME)
def test_a_file_shows_positions_where_opencv_does(file: Path, name: str) -> None:
    content, model, D = SAME[name]
    camera = read(file, content)
    assert (camera.width, camera.height) in ((640, 480), (None, None))
    xyz = np.random.default_rng(0).uniform([-1, -0.8, 2], [1, 0.8, 4], (100, 3))
    expected = projected(xyz, np.reshape(MATRIX, (3, 3)) + HALF, Lens(tuple(D), model == KB))
    K = np.reshape(camera.K, (3, 3))
    found = K[:2, 2] + 0.5 + np.diagonal(K)[:2] * Lens(camera.D, camera.model == KB).distort(xyz)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["ROS", "OpenCV", "ROS, INI", "OpenCV, XML", "COLMAP", "BOP"])
def test_a_mark_of_the_byte_order_and_the_suffix_do_not_matter(file: Path, name: str) -> None:
    content = SAME[name][0]
    assert read(file.with_suffix(".txt"), content, "utf-8-sig") == read(file, content)


def test_pixels_count_from_the_corner_and_the_size_must_be_that_of_the_image(file: Path) -> None:
    read(file, ros())
    (detection,) = detections_of([Path("photo.jpg")], {"camera": str(file)})
    assert detection.focal_lengths_and_centre(640, 480) == (400.5, 401.2, 320, 240)
    with pytest.raises(DatasetError, match=r"photo\.jpg: camera=.*: is for images of 640 x 480 .* has 320 x 240"):
        detection.focal_lengths_and_centre(320, 240)
    read(file, ros(image_width=None, image_height=None))
    (detection,) = detections_of([Path("photo.jpg")], {"camera": str(file)})
    assert detection.focal_lengths_and_centre(320, 240) == (400.5, 401.2, 320, 240)


def test_a_file_that_opencv_writes_now(file: Path) -> None:
    cv2 = pytest.importorskip("cv2", reason="OpenCV, the oracle of lenses, is not installed")
    for suffix in (".yml", ".xml", ".json"):
        for coefficients in (np.array(FIVE), np.array(FIVE)[None], np.array(FIVE)[:, None]):
            path = file.with_suffix(suffix)
            storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
            storage.write("camera_matrix", np.array(MATRIX).reshape(3, 3))
            storage.write("distortion_coefficients", coefficients)
            storage.release()
            camera = read_camera(path)
            assert [*camera.K, *camera.D] == MATRIX + FIVE


def test_a_focal_length_in_millimetres_is_refused_unless_the_lens_is_a_fisheye(file: Path) -> None:
    with pytest.raises(DatasetError, match=r"photo\.jpg: .*18 x 18 pixels.* shows 174 degrees; .*f in millimetres"):
        detections_of([Path("photo.jpg")], {"f": 18.0})[0].focal_lengths_and_centre(640, 480)
    K = [80.0, *MATRIX[1:4], 80.0, *MATRIX[5:]]
    for model, D in ((BROWN, FIVE), (KB, FISHEYE)):
        read(file, ros_with(model, D, camera_matrix=matrix(K)))
        (detection,) = detections_of([Path("photo.jpg")], {"camera": str(file)})
        if model == KB:
            assert detection.focal_lengths_and_centre(640, 480)[0] == 80
        else:
            with pytest.raises(DatasetError, match="shows 152 degrees; expected at most 150"):
                detection.focal_lengths_and_centre(640, 480)


RIG = anipose(FOUR).replace("cam_0", "cam_1").replace("400.5", "900").replace("metadata", "more")
TWO = kalibr(FOUR, "radtan") | {"cam1": kalibr(FISHEYE, "equidistant")["cam0"]}
BAD: list[tuple[Any, str]] = [
    (ros(camera_matrix=None), "no camera matrix: found image_width, image_height, camera_name, distortion_model"),
    (ros(distortion_coefficients=None), "no coefficients of plumb_bob: found image_width, image_height"),
    (ros(camera_matrix=matrix(MATRIX[:8])), "camera_matrix: got 8 numbers in data; expected rows x cols = [3, 3]"),
    (ros(camera_matrix=matrix(MATRIX[:6], 2, 3)), "camera matrix: got [400.5"),
    (ros(camera_matrix=matrix([0.9, *MATRIX[1:4], 0.001, *MATRIX[5:]])), "expected [fx, 0, cx, 0, fy"),
    (ros(camera_matrix=matrix([float("nan"), *MATRIX[1:]])), "camera_matrix: got nan; expected numbers"),
    (ros(camera_matrix="wide"), "camera_matrix: got 'wide'; expected numbers"),
    (ros(distortion_model="thin_plate"), "distortion_model: got 'thin_plate'; expected plumb_bob, "),
    (ros(distortion_model=KB), "got [-0.28, 0.07, 0.0005, -0.0003, 0.01]; expected k1, k2, k3, k4 for equidistant"),
    (ros(distortion_coefficients=matrix([0.1] * 3, 1, 3)), "expected k1, k2, p1, p2, k3 for plumb_bob"),
    (ros(image_width=0), "width: got 0; expected to be greater than 0"),
    (ros(xi=1.2), "xi: got 1.2, a part of a lens that is not supported"),
    (ros(lens={"radial_terms": [0.1]}), "lens.radial_terms: got [0.1], a part of a lens"),
    ({"K": MATRIX, "D": FOUR}, "add distortion_model: plumb_bob (k1, k2, p1, p2) or equidistant"),
    (CORNER | named(FIRST + " k3 k4", [*FOUR, 0, 0.1]) | {"camera_model": "OPENCV"}, "zero beyond"),
    (named("fx fy", [1, 2]), "cx is missing: found fx, fy"),
    (F | {"K": [900, *MATRIX[1:]]}, "K and fx differ; expected the calibration of one camera alone"),
    (F | {"D": FIVE, "k1": 0.1}, "D and k1 are two lenses"),
    (F | {"D": FOUR, "camera_model": "none"}, "expected none for none"),
    (F | {"coeffs": FOUR, "model": "inverse_brown_conrady"}, "coeffs: got [-0.28, 0.07, 0.0005, -0.0003], a part of"),
    (F | {"D1": FOUR}, "D1: got [-0.28, 0.07, 0.0005, -0.0003], a part of a lens that is not supported"),
    (TWO, "cam0.distortion_coeffs and cam1.distortion_coeffs differ; expected the calibration of one camera alone"),
    (
        {"K_left": ROWS, "K_right": [*ROWS[:2], [0, 0, 2]]},
        "no camera matrix: found K_left, K_right; expected ROS (camera_info, ost.ini), ",
    ),
    (anipose(FOUR) + RIG, "cam_0.matrix and cam_1.matrix"),
    (
        {"cameraData": [[2, {"intrinsicMatrix": ROWS, "width": 640}]]},
        "DepthAI's calibration: write intrinsicMatrix, ",
    ),
    (
        {"FocalLength": [1200.5, 1199.8], "RadialDistortion": [640, 358]},
        "MATLAB's cameraIntrinsics: write K with both",
    ),
    ("{K: '[[400, 0], [0, 400]]'}\n{D: '[[0.1], [0]]'}\n", "Expecting property name enclosed in double quotes"),
    ("400 400 320\n", "3 numbers; expected K, 3 x 3, or one line of fx fy cx cy, or with k1 k2 p1 p2; expected ROS"),
    (F | {"roi": {"x_offset": "left"}}, "roi: got 'left'; expected numbers up to 1000000"),
    (F | {"binning_x": []}, "list index out of range"),
    ({"imu0": {"model": "kalibr"}}, "no camera matrix: found imu0.model"),
    ("1 FOV 640 480 400 400 320 240 0.9", "FOV with 5 parameters; expected one of SIMPLE_PINHOLE"),
    ("<calibration><f>900</f></calibration>", "XML of <calibration>; expected <opencv_storage>"),
    ("<a", "XML: "),
    ('<!DOCTYPE a [<!ENTITY b "c">]><opencv_storage/>', "XML with a document type declaration"),
    ({"camera_angle_x": 0.7, "frames": []}, "no camera matrix: found camera_angle_x, frames; expected ROS"),
    ("a: [1", "while parsing"),
    ('{"a": ', "Expecting value"),
    ("", "no camera matrix: found no keys"),
    ("a: !!python/object:os.system {}", "could not determine a constructor"),
]


@pytest.mark.parametrize(("content", "said"), BAD, ids=[said[:40] for _, said in BAD])
def test_a_broken_file_is_one_line_that_names_it(file: Path, content: Any, said: str) -> None:
    with pytest.raises(DatasetError) as caught:
        read(file, content)
    assert str(caught.value).startswith(f"{file}: ")
    assert said in str(caught.value)
    assert str(caught.value).endswith("; see `Lenses` in docs/guides/own_images.md")
    assert "\n" not in str(caught.value)


def test_no_file_and_no_text_are_one_line_each(file: Path) -> None:
    with pytest.raises(DatasetError, match=r"camera\.yaml: No such file or directory; see"):
        read_camera(file)
    file.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DatasetError, match=r"camera\.yaml: 'utf-8' codec can't decode"):
        read_camera(file)

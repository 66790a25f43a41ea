"""Camera files of many tools: what a tool writes comes back, or one line says what was found and expected."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from phd_exp.records.cameras import COEFFICIENTS, Calibration, read_camera
from phd_exp.records.detections import detections_of
from phd_exp.records.errors import DatasetError

BROWN, RATIONAL, KB = COEFFICIENTS


class Camera(NamedTuple):
    """A camera of 640 x 480 pixels; pixels count from the centre of the first one."""

    fx: float
    fy: float
    cx: float
    cy: float
    model: str
    D: list[float]

    @property
    def K(self) -> list[float]:
        return [self.fx, 0.0, self.cx, 0.0, self.fy, self.cy, 0.0, 0.0, 1.0]

    @property
    def rows(self) -> list[list[float]]:
        return np.reshape(self.K, (3, 3)).tolist()

    @property
    def named(self) -> dict[str, float]:
        return dict(zip(COEFFICIENTS[self.model], self.D, strict=True))

    @property
    def from_corner(self) -> list[float]:
        """fx, fy, cx, cy of tools that count pixels from the corner of the first one."""
        return [self.fx, self.fy, self.cx + 0.5, self.cy + 0.5]


def matrix(data: list[Any], rows: int = 3, cols: int = 3) -> dict[str, Any]:
    return {"rows": rows, "cols": cols, "data": data}


def ros(camera: Camera, D: list[Any] | None = None, **changes: Any) -> dict[str, Any]:
    """A `camera_info` as ROS's calibrator writes it."""
    D = camera.D if D is None else D
    values = {"image_width": 640, "image_height": 480, "camera_name": "stereo", "camera_matrix": matrix(camera.K)}
    values |= {"distortion_model": camera.model, "distortion_coefficients": matrix(D, 1, len(D))}
    values |= {"projection_matrix": matrix([380.0, 0, 320, 0, 0, 380, 240, 0, 0, 0, 1, 0], 3, 4)} | changes
    return {key: value for key, value in values.items() if value is not None}


def message(camera: Camera, lower: bool = False) -> str:
    """A message of the topic `camera_info`, as `rostopic echo` and `ros2 topic echo` print it."""
    values = {"header": {"stamp": {"secs": 1, "nsecs": 2}}, "height": 480, "width": 640}
    values |= {"distortion_model": camera.model, "D": camera.D, "K": camera.K, "R": camera.K, "P": [1.0] * 12}
    values |= {"roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}}
    return yaml.safe_dump({key.lower() if lower else key: value for key, value in values.items()}) + "---\n"


def opencv(camera: Camera, more: str = "", names: str = "camera_matrix distortion_coefficients", nd: str = "") -> str:
    """A `FileStorage` as OpenCV 3, 4 and 5 write it."""
    K, D = names.split()
    sizes = "sizes: [ 5 ]" if nd else f"rows: {len(camera.D)}\n   cols: 1"
    more += "fisheye_model: 1\n" if camera.model == KB else ""
    return (
        f"%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\n{more}"
        f"{K}: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: {camera.K}\n"
        f"{D}: !!opencv-{nd}matrix\n   {sizes}\n   dt: d\n   data: {camera.D}\n"
        'image_points: !!opencv-matrix\n   rows: 1\n   cols: 2\n   dt: "2f"\n   data: [ 1., 2., 3., 4. ]\n'
    )


def ini(camera: Camera) -> str:
    rows = "\n".join(" ".join(map(str, row)) for row in camera.rows)
    return (
        f"# oST version 5.0 parameters\n\n\n[image]\n\nwidth\n640\n\nheight\n480\n\n[cam/left]\n\ncamera matrix\n"
        f"{rows}\n\ndistortion\n{' '.join(map(str, camera.D))}\n\nrectification\n1 0 0\n0 1 0\n0 0 1\n"
    )


def kalibr(camera: Camera, name: str = "cam0") -> dict[str, Any]:
    model = {BROWN: "radtan", KB: "equidistant"}[camera.model]
    lens = {"camera_model": "pinhole", "distortion_coeffs": camera.D[:4], "distortion_model": model}
    return {name: lens | {"intrinsics": camera[:4], "resolution": [640, 480], "rostopic": "/a"}}


def anipose(camera: Camera, name: str = "cam_0") -> str:
    rows = str(camera.rows).replace("]", ",]")
    more = "fisheye = true\n" if camera.model == KB else ""
    lens = f"size = [ 640, 480,]\nmatrix = {rows}\ndistortions = {camera.D}\n{more}rotation = [ 0.1, 0.2, 0.3,]\n"
    return f'[{name}]\nname = "A"\n{lens}translation = [ -17.68, 8.876, -34.37,]\n'


def colmap(camera: Camera) -> str:
    model = {BROWN: "OPENCV", RATIONAL: "FULL_OPENCV", KB: "OPENCV_FISHEYE"}[camera.model]
    order = [camera.named[name] for name in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6") if name in camera.named]
    D = order[:4] if camera.model == BROWN else order
    return "# Camera list\n" + " ".join(map(str, [1, model, 640, 480, *camera.from_corner, *D])) + "\n"


def nerfstudio(camera: Camera, model: dict[str, Any] | None = None) -> dict[str, Any]:
    model = {"camera_model": {BROWN: "OPENCV", KB: "OPENCV_FISHEYE"}[camera.model]} if model is None else model
    intrinsics = dict(zip(("fl_x", "fl_y", "cx", "cy"), camera.from_corner, strict=True))
    return intrinsics | {"w": 640, "h": 480, **model, "frames": [{"file_path": "a.png"}]} | camera.named


def text(camera: Camera) -> str:
    return " ".join(map(str, [*camera[:4], *camera.D]))


def plain(camera: Camera, K: str = "K", D: str = "D", **more: Any) -> dict[str, Any]:
    return {K: camera.rows, D: [camera.D], **more}


FOUR = "four coefficients"  # k3 is zero
FORMATS: dict[str, tuple[Callable[[Camera], Any], tuple[str, ...]]] = {
    "ROS": (ros, (BROWN, RATIONAL, KB)),
    "ROS, yaml-cpp": (lambda c: ros(c, [*map("{:.17e}".format, c.D)]), (BROWN,)),
    "ROS, one coefficient too many": (lambda c: ros(c, [*c.D, 0]), (KB,)),
    "ROS, camera_model": (lambda c: ros(c, distortion_model=None, camera_model=KB), (KB,)),
    "rostopic echo": (message, (BROWN, RATIONAL)),
    "ros2 topic echo": (lambda c: 2 * message(c, lower=True), (BROWN, RATIONAL)),
    "ROS, INI": (ini, (BROWN, RATIONAL)),
    "OpenCV": (opencv, (BROWN, RATIONAL, KB)),
    "OpenCV 5": (lambda c: opencv(c, nd="nd-").replace(":1.0", " 1.2"), (BROWN,)),
    "OpenCV, K": (lambda c: opencv(c, "distortion_model: radtan\n", "K D"), (FOUR,)),
    "OpenCV, interactive-calibration": (
        lambda c: opencv(c, "dist_coeffs_std_dev: [0.1, 0.2]\n", "cameraMatrix dist_coeffs"), (BROWN,),
    ),
    "Kalibr": (kalibr, (FOUR, KB)),
    "Anipose": (anipose, (BROWN, KB)),
    "COLMAP": (colmap, (FOUR, RATIONAL, KB)),
    "nerfstudio": (nerfstudio, (BROWN, KB)),
    "nerfstudio, frames": (lambda c: {"frames": [nerfstudio(c)] * 2}, (BROWN,)),
    "instant-ngp": (lambda c: nerfstudio(c, {}) | {"is_fisheye": False, "k4": 0}, (BROWN,)),
    "fx fy cx cy, DROID-SLAM": (text, (BROWN, FOUR)),
    "JSON of NumPy": (plain, (BROWN, RATIONAL)),
    "JSON of NumPy, quoted": (lambda c: {"K": str(c.rows), "D": str([c.D])}, (BROWN,)),
    "JSON of NumPy, names": (lambda c: plain(c, "camera_matrix", "dist_coeff", image_size=[640, 480]), (BROWN,)),
}  # fmt: skip
"""Tool -> how it writes a camera, and the models that it has."""
WITHOUT: dict[str, Callable[[Camera], Any]] = {
    "ROS, none": lambda c: ros(c, [], distortion_model="none"),
    "ROS, no name": lambda c: ros(c, [0.0] * 7, distortion_model=""),
    "Kalibr, none": lambda c: {"cam0": {"intrinsics": c[:4], "distortion_model": "none", "distortion_coeffs": []}},
    "OpenCV, three zeros": lambda c: opencv(c._replace(D=[0, 0, 0])),
    "cam_K.txt": lambda c: "\n".join("\t".join(map("{:.17e}".format, row)) + "\t" for row in c.rows) + "\n",
    "cam_K.txt, commas": lambda c: "\n".join(", ".join(map(str, row)) for row in c.rows),
    "fx fy cx cy": lambda c: "  " + " ".join(map(str, c[:4])) + "\n",
    "BOP": lambda c: dict(zip(("fx", "fy", "cx", "cy"), c[:4], strict=True)) | {"depth_scale": 0.1, "width": 640},
    "BOP, scene": lambda c: {"0": {"cam_K": c.K, "depth_scale": 1.0}, "7": {"cam_K": c.K}},
    "COLMAP, pinhole": lambda c: 2 * ("1 PINHOLE 640 480 " + " ".join(map(str, c.from_corner)) + "\n"),
}
"""The same for cameras without distortion."""
focal, centre = st.floats(10, 1e4, width=32), st.integers(0, 2000).map(lambda n: n / 4)
coefficient = st.floats(1e-3, 0.5) | st.floats(-0.5, -1e-3)


@st.composite
def cameras(draw: st.DrawFn, model: str = BROWN) -> Camera:
    """Cameras of a model."""
    D = draw(st.tuples(*[coefficient] * len(COEFFICIENTS[BROWN if model == FOUR else model])))
    numbers = [draw(one) for one in (focal, focal, centre, centre)]
    return Camera(*numbers, BROWN, [*D[:4], 0.0]) if model == FOUR else Camera(*numbers, model, list(D))


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cameras") / "camera.yaml"


def read(file: Path, content: Any, encoding: str = "utf-8") -> Calibration:
    file.write_text(content if isinstance(content, str) else json.dumps(content), encoding)
    return read_camera(file)


@pytest.mark.parametrize(
    ("name", "model"), [(name, model) for name, (_, models) in FORMATS.items() for model in models]
)
@settings(max_examples=10, deadline=None)
@given(data=st.data())
def test_a_camera_comes_back(file: Path, name: str, model: str, data: st.DataObject) -> None:
    camera = data.draw(cameras(model))
    encoding = data.draw(st.sampled_from(["utf-8", "utf-8-sig"]))
    found = read(file.with_suffix(data.draw(st.sampled_from([".yaml", ".txt"]))), FORMATS[name][0](camera), encoding)
    assert (found.width, found.height) in ((640, 480), (None, None))
    assert (found.K, found.D, found.model) == (tuple(camera.K), tuple(camera.D), camera.model)


@pytest.mark.parametrize("name", WITHOUT)
@settings(max_examples=10, deadline=None)
@given(camera=cameras())
def test_a_camera_without_distortion_comes_back(file: Path, name: str, camera: Camera) -> None:
    found = read(file, WITHOUT[name](camera))
    assert (found.K, set(found.D), found.model) == (tuple(camera.K), {0.0}, BROWN)


CAMERA = Camera(400.5, 401.2, 319.5, 239.5, BROWN, [-0.28, 0.07, 0.0005, -0.0003, 0.01])
FISHEYE = CAMERA._replace(model=KB, D=[-0.03, 0.004, -0.002, 0.0003])


def test_pixels_count_from_the_corner_and_the_size_must_be_that_of_the_image(file: Path) -> None:
    read(file, ros(CAMERA))
    (detection,) = detections_of([Path("photo.jpg")], {"camera": str(file)})
    assert detection.optics(640, 480)[0].tolist() == [[400.5, 0, 320], [0, 401.2, 240], [0, 0, 1]]
    with pytest.raises(DatasetError, match=r"photo\.jpg: camera=.*: is for images of 640 x 480 .* has 320 x 240"):
        detection.optics(320, 240)
    read(file, ros(CAMERA, image_width=None, image_height=None))
    (detection,) = detections_of([Path("photo.jpg")], {"camera": str(file)})
    assert detection.optics(320, 240)[0][0, 0] == 400.5


@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
def test_a_file_that_opencv_writes_now(file: Path, suffix: str) -> None:
    cv2 = pytest.importorskip("cv2", reason="OpenCV, the oracle of lenses, is not installed")
    for coefficients in (np.array(CAMERA.D), np.array(CAMERA.D)[None], np.array(CAMERA.D)[:, None]):
        storage = cv2.FileStorage(str(path := file.with_suffix(suffix)), cv2.FILE_STORAGE_WRITE)
        storage.write("camera_matrix", np.array(CAMERA.rows))
        storage.write("distortion_coefficients", coefficients)
        storage.release()
        found = read_camera(path)
        assert [*found.K, *found.D] == CAMERA.K + CAMERA.D


def test_a_focal_length_in_millimetres_is_refused_unless_the_lens_is_a_fisheye(file: Path) -> None:
    with pytest.raises(DatasetError, match=r"photo\.jpg: .*18 x 18 pixels.* shows 174 degrees; .*f in millimetres"):
        detections_of([Path("photo.jpg")], {"f": 18.0})[0].optics(640, 480)
    wide, fisheye = (ros(camera._replace(fx=80.0, fy=80.0)) for camera in (CAMERA, FISHEYE))
    read(file, fisheye)
    assert detections_of([Path("a")], {"camera": str(file)})[0].optics(640, 480)[0][0, 0] == 80
    read(file, wide)
    with pytest.raises(DatasetError, match="shows 152 degrees; expected at most 150"):
        detections_of([Path("a")], {"camera": str(file)})[0].optics(640, 480)


F = dict(zip(("fx", "fy", "cx", "cy"), CAMERA, strict=False))
TWO = "two values; expected the calibration of one camera alone"
BAD: list[tuple[Any, str]] = [
    (ros(CAMERA, camera_matrix=None), "no camera matrix: found image_width, image_height, camera_name, distortion_"),
    (ros(CAMERA, distortion_coefficients=None), "D: missing; expected the coefficients of plumb_bob"),
    (ros(CAMERA._replace(fx=0.9, fy=0.001)), "expected [fx, 0, cx, 0, fy"),
    (ros(CAMERA._replace(fx=float("nan"))), "K.0: got nan; expected to be a finite number"),
    (ros(CAMERA, distortion_model="thin_plate"), "distortion_model: got 'thin_plate'; expected plumb_bob, "),
    (ros(CAMERA, distortion_model=KB), "got [-0.28, 0.07, 0.0005, -0.0003, 0.01]; expected k1, k2, k3, k4 for equi"),
    (ros(CAMERA, [0.1] * 3), "expected k1, k2, p1, p2, k3 for plumb_bob"),
    (ros(CAMERA, image_width=0), "width: got 0; expected to be greater than 0"),
    (ros(CAMERA, xi=1.2), "xi: got 1.2, a part of a lens that is not supported"),
    (ros(CAMERA, roi={"x_offset": "left"}), "roi.x_offset: got 'left'; expected a valid integer"),
    ({"K": CAMERA.K, "D": CAMERA.D[:4]}, "add distortion_model: plumb_bob (k1, k2, p1, p2) or equidistant"),
    (F | {"k1": 0.1}, "1 coefficients of no model; add distortion_model"),
    (F | {"K": FISHEYE._replace(fx=9.0).K}, "K: differs from fx, fy, cx, cy"),
    (plain(CAMERA) | {"k1": 0.1}, "D and k1: are two lenses; expected one"),
    (kalibr(CAMERA) | kalibr(FISHEYE, "cam1"), f"cam1.distortion_coeffs: has {TWO}"),
    (anipose(CAMERA) + anipose(CAMERA._replace(fx=900.0), "cam_1"), f"cam_1.matrix: has {TWO}"),
    ("400 400 320\n", "3 numbers; expected K, 3 x 3, or one line of fx fy cx cy, or with k1 k2 p1 p2; expected ROS"),
    ("<calibration><f>900</f></calibration>", "XML of <calibration>; expected <opencv_storage>"),
    ('<!DOCTYPE a [<!ENTITY b "c">]><opencv_storage/>', "XML with a document type declaration"),
    ("a: [1", "while parsing"),
    ("", "no camera matrix: found no keys"),
    (None, "No such file or directory"),
    (b"\xff\xfe\x00", "'utf-8' codec can't decode"),
]


@pytest.mark.parametrize(("content", "said"), BAD, ids=[said[:40] for _, said in BAD])
def test_a_broken_file_is_one_line_that_names_it(file: Path, content: Any, said: str) -> None:
    file.unlink(missing_ok=True)
    if content is not None:
        text = content if isinstance(content, str | bytes) else json.dumps(content)
        file.write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(DatasetError) as caught:
        read_camera(file)
    assert str(caught.value).startswith(f"{file}: cannot be read (")
    assert said in str(caught.value)
    assert str(caught.value).endswith("; see `Lenses` in docs/guides/own_images.md")
    assert "\n" not in str(caught.value)

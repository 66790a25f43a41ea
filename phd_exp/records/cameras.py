"""Camera files: size, intrinsics and lens of a camera, from the calibration file of any common tool.

The whole file is searched for the names in `NAMES`. Two values of one quantity are refused: the file then describes
several cameras.

Source: documentation of OpenCV (FileStorage, calib3d), ROS (camera_info), Kalibr, COLMAP (cameras.txt), nerfstudio
(transforms.json), BOP (camera.json) and Anipose (calibration.toml).
"""

import math
import re
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, Field, model_validator

from phd_exp.optics.lens import Lens
from phd_exp.optics.virtual import require_no_fold
from phd_exp.records.camera_files import READ, content_of, entries
from phd_exp.records.errors import DatasetError, gist, listed, reading, shown
from phd_exp.records.files import LARGEST_RECORD, MB, read_plain
from phd_exp.records.parsing import Record, parse_json

CORNER = 0.5  # px from the corner of the first pixel to its centre
LARGEST = 1e6  # of any number in a camera file
WIDEST = 150  # degrees that an image may show, unless through a fisheye
SHORTEST = 0.01  # focal length, px; a shorter one is probably in metres
RULE = "see `Lenses` in docs/guides/own_images.md"
ONE_CAMERA = "expected the calibration of one camera alone"
Model = Literal["plumb_bob", "rational_polynomial", "equidistant"]
COEFFICIENTS = {
    "plumb_bob": ("k1", "k2", "p1", "p2", "k3"),
    "rational_polynomial": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "equidistant": ("k1", "k2", "k3", "k4"),
}
NAMES = {
    "width": "imagewidth width w",
    "height": "imageheight height h",
    "size": "resolution imagesize cameraresolution size",
    "K": "k cameramatrix camk mtx intrinsics matrix",
    **{"fx": "fx flx", "fy": "fy fly", "cx": "cx", "cy": "cy"},
    "D": "d dist distcoeff distcoeffs distortion distortions distortioncoeffs distortioncoefficients",
    "model": "distortionmodel cameramodel",
    "fisheye": "fisheyemodel isfisheye fisheye",
    **{"binning_x": "binningx", "binning_y": "binningy", "roi": "roi"},
    **{name: name for name in COEFFICIENTS["rational_polynomial"]},
}
"""Quantity -> its names in files, in small letters and digits."""
MODELS = {
    "plumb_bob": "plumbbob radtan brownconrady opencv radial simpleradial",
    "rational_polynomial": "rationalpolynomial fullopencv",
    "equidistant": "equidistant equi fisheye kannalabrandt opencvfisheye radialfisheye simpleradialfisheye",
    "none": "none",
    "": "pinhole perspective simplepinhole",  # the coefficients tell which
}
"""Model -> its names in files, in small letters and digits."""
_QUANTITIES = {alias: name for name, aliases in NAMES.items() for alias in aliases.split()}
_MODELS = {"": "none"} | {alias: model for model, aliases in MODELS.items() for alias in aliases.split()}
_COEFFICIENT, _LENS = re.compile(r"[dkps]\d|xi|skew"), re.compile(r"distor|radial|tangential|coef(?!.*stddev)")
"""Names that belong to a lens even where they are none of `NAMES`."""


def _flat(value: Any) -> list[Any]:
    """The items of a list, of nested lists, of a matrix with data, or of one of these in quotation marks."""
    value = value["data"] if isinstance(value, dict) else value
    value = parse_json(value) if isinstance(value, str) and value.startswith("[") else value
    return [number for item in value for number in _flat(item)] if isinstance(value, list) else [value]


def _only(value: Any) -> Any:
    """The only item of a list, as ROS's INI has it; other values are returned unchanged."""
    return value[0] if isinstance(value, list) and len(value) == 1 else value


Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST, allow_inf_nan=False)]
Size = Annotated[int, Field(gt=0)]
Side = Annotated[Size | None, BeforeValidator(_only)]
Numbers = Annotated[list[Number], BeforeValidator(_flat)]


class Calibration(Record):
    """The content of a camera file, where the centre of the first pixel is (0, 0).

    Attributes:
        width, height: of the images, px; not in every file.
        K: camera matrix, row by row, px.
        D: k1, k2, p1, p2, k3 to k6; or k1 to k4 of a fisheye.
        model: of the distortion, as ROS names it.
    """

    width: Size | None
    height: Size | None
    K: tuple[float, ...]
    D: tuple[float, ...]
    model: Model

    @property
    def intrinsics(self) -> NDArray[np.float64]:
        """Camera matrix (3, 3) of pixels that count from the corner of the first one."""
        K = np.array(self.K).reshape(3, 3)
        K[:2, 2] += CORNER
        return K

    @cached_property
    def lens(self) -> Lens:
        """The lens: one object for all detections of the camera, which caches what it computes."""
        return Lens(self.D[:8], self.model == "equidistant")

    @model_validator(mode="after")
    def has_no_skew(self) -> "Calibration":
        """Refuse skew, and a focal length that is not in pixels."""
        K = self.K
        if len(K) != 9 or min(K[0], K[4]) < SHORTEST or (K[1], K[3], *K[6:]) != (0, 0, 0, 0, 1):
            raise ValueError(f"camera matrix: got {list(K)}; expected [fx, 0, cx, 0, fy, cy, 0, 0, 1] in pixels")
        return self


class _Region(BaseModel):
    """ROS's region of interest in pixels of the sensor; zeros for all of it."""

    x_offset: int = 0
    y_offset: int = 0
    width: int = 0
    height: int = 0


class _Described(BaseModel):
    """A camera as its file describes it, by the quantities of `NAMES`.

    Attributes:
        corner: where its tool's pixel (0, 0) lies in this package's camera files, px.
        named: coefficients with names.
    """

    width: Side = None
    height: Side = None
    size: Annotated[tuple[Size, Size], BeforeValidator(_flat)] | None = None
    K: Numbers = []
    corner: float = 0.0
    fx: Number | None = None
    fy: Number | None = None
    cx: Number | None = None
    cy: Number | None = None
    D: Numbers | None = None
    named: dict[str, Number] = {}
    model: str | None = None
    fisheye: bool | None = None
    binning_x: int = 1
    binning_y: int = 1
    roi: _Region = _Region()

    @property
    def matrix(self) -> list[float]:
        """K by rows."""
        fx, fy, cx, cy = self.K if len(self.K) == 4 else (self.fx, self.fy, self.cx, self.cy)
        if fx is None:
            return self.K
        if fy is None or cx is None or cy is None:
            raise ValueError("fx, fy, cx, cy: one is missing; expected all of them")
        rows = [fx, 0.0, cx - self.corner, 0.0, fy, cy - self.corner, 0.0, 0.0, 1.0]
        if len(self.K) == 9 and rows != self.K:
            raise ValueError(f"K: differs from fx, fy, cx, cy; {ONE_CAMERA}")
        return rows

    @property
    def lens(self) -> tuple[Any, list[float]]:
        """The model, and its coefficients, with zeros for those that the file leaves out."""
        D, named, model = self.D or [], self.named, self.model or ("equidistant" if self.fisheye else None)
        if any(D) and any(named.values()):
            raise ValueError(f"D and {', '.join(named)}: are two lenses; expected one")
        if model in COEFFICIENTS and self.D is None and not named:
            raise ValueError(f"D: missing; expected the coefficients of {model}")
        if not any([*D, *named.values()]):
            model = model if model in COEFFICIENTS else "plumb_bob"
            return model, [0.0] * len(COEFFICIENTS[model])
        names = COEFFICIENTS.get(model := model or self._only_model(), ())
        given = named or dict(zip([*names, *map(str, range(len(D)))], D, strict=False))
        # fewer than four are of another model
        if 0 < len(D) < 4 or any(value for name, value in given.items() if name not in names):
            expected = f"{', '.join(names) or 'none'} for {model}, zero beyond"
            raise ValueError(f"coefficients: got {D or named}; expected {expected}")
        return model, [given.get(name, 0.0) for name in names]

    def _only_model(self) -> str:
        """The only model with coefficients of these names, or so many. Raises ValueError if there are two."""
        n, is_pinhole = len(self.D or ()), self.fisheye is False or bool(self.named.keys() & {"p1", "p2"})
        if n in (8, 12, 14) or (is_pinhole and "k6" in self.named):
            return "rational_polynomial"
        if n == 5 or (is_pinhole and n <= 4):
            return "plumb_bob"
        raise ValueError(
            f"{n or len(self.named)} coefficients of no model; add distortion_model: plumb_bob (k1, k2, p1, p2) or "
            "equidistant (k1, k2, k3, k4)"
        )


def read_camera(path: Path) -> Calibration:
    """The calibration in a camera file. Raises DatasetError, one line that names the file, if there is none."""
    with reading(path, RULE):
        # YAML takes seconds a megabyte
        text = read_plain(path, LARGEST_RECORD if path.suffix == ".json" else MB).decode("utf-8-sig")
        return calibration_in(content_of(text))


def calibration_in(content: Any, image: tuple[int, int] | None = None) -> Calibration:
    """The calibration in the content of a camera file. Raises ValueError if there is none.

    `image` is the size of the images, where it is known.
    """
    described = _described(content)
    (width, height), (model, D) = described.size or (described.width, described.height), described.lens
    sensor = Calibration(width=width, height=height, K=tuple(described.matrix), D=tuple(D), model=model)
    return _read_out(sensor, described, image)


def _described(content: Any) -> _Described:
    """The quantities of a file. Raises ValueError if one has two values, or there is no focal length."""
    values = list(entries(content))
    found: dict[str, Any] = {}
    for key, value in values:
        name = _quantity(key, value)
        if name == "model":
            given, value = value, _MODELS.get(_plain(value))
            if value is None:
                raise ValueError(f"{key}: got {shown(given)}; expected {', '.join(COEFFICIENTS)}, or another name")
        if name == "fx" and "fl" in key.lower():  # COLMAP and nerfstudio, which count pixels from the corner
            found["corner"] = CORNER
        if name and value != "" and found.setdefault(name, value) != value:
            raise ValueError(f"{key}: has two values; {ONE_CAMERA}")
    if not {"K", "fx"} & found.keys():
        raise ValueError(f"no camera matrix: found {listed([*dict(values)]) or 'no keys'}; expected {READ}")
    named = {name: found[name] for name in COEFFICIENTS["rational_polynomial"] if name in found}
    return _Described(**{name: found[name] for name in found.keys() & _Described.model_fields}, named=named)


def _quantity(key: str, value: Any) -> str | None:
    """The quantity with a key, if it is one. Raises ValueError for a part of a lens that is none."""
    outer, _, name = key.rpartition(".")
    quantity = _QUANTITIES.get(_plain(name))
    is_list = isinstance(value, list | dict)
    of_a_lens = _COEFFICIENT.fullmatch(_plain(name)) or _LENS.search(_plain(key if is_list else outer))
    if quantity is None and of_a_lens and not isinstance(value, str) and re.search("[1-9]", str(value)):
        raise ValueError(f"{key}: got {shown(value)}, a part of a lens that is not supported; expected zero")
    return quantity


def _plain(name: Any) -> str:
    return re.sub(r"[^a-z\d]", "", str(name).lower())


def _read_out(sensor: Calibration, described: _Described, image: tuple[int, int] | None) -> Calibration:
    """The camera of the pixels that ROS's region of interest and binning leave of a sensor.

    The region is in pixels of the sensor; a binned pixel covers a rectangle of them. Raises ValueError if the images
    have another size. Some drivers give the size of their images as that of the sensor, which is accepted where the
    principal point is then nearer to the middle.

    Source: the definition of sensor_msgs/CameraInfo.
    """
    region, bins = described.roi, [max(1, described.binning_x), max(1, described.binning_y)]
    if region == _Region() and bins == [1, 1]:
        return sensor
    full, whole = sensor.intrinsics, (sensor.width or 0, sensor.height or 0)
    expected = (region.width or whole[0]) // bins[0], (region.height or whole[1]) // bins[1]
    K = np.diag([*np.divide(1, bins), 1]) @ (full - [[0, 0, region.x_offset], [0, 0, region.y_offset], [0, 0, 0]])
    if image and image != expected:
        nearer, farther = (np.linalg.norm(one[:2, 2] - np.divide(image, 2)) for one in (K, full))
        if image != whole or nearer > farther:
            raise ValueError(
                f"binning {bins} and region {[*region.model_dump().values()]} of {whole} make no images of {image}; "
                "expected width, height and K of the whole sensor"
            )
    width, height = image or expected
    K[:2, 2] -= CORNER
    return sensor.model_copy(
        update={"width": width or None, "height": height or None, "K": tuple(K.ravel().tolist())}
    )


def calibration(given: Any) -> Calibration | None:
    """The camera of images of a known size: a file, the numbers f, width and height, or the content of a record.

    Raises ValueError if it is none, or its size is not known.
    """
    if given is None or isinstance(given, Calibration):
        return given
    try:
        if isinstance(given, dict) and "f" in given:
            f, width, height = (given[name] for name in ("f", "width", "height"))
            K = (f, 0, width / 2 - CORNER, 0, f, height / 2 - CORNER, 0, 0, 1)
            given = {"width": width, "height": height, "K": K, "D": (), "model": "plumb_bob"}
        camera = read_camera(Path(given)) if isinstance(given, (str, Path)) else Calibration(**given)
    except (DatasetError, TypeError, ValueError) as error:
        raise ValueError(f"camera: {gist(error)}") from None
    if not (camera.width and camera.height):
        raise ValueError(f"camera: {given} does not say the size of the images; add width and height to the file")
    require_possible(camera.intrinsics, camera.lens, camera.width, camera.height)
    return camera


def require_possible(K: NDArray[np.float64], lens: Lens, width: int, height: int) -> None:
    """Raise ValueError if a lens folds over inside an image, or one without a fisheye shows more than `WIDEST`."""
    fx, fy = np.diagonal(K)[:2]
    angle = math.degrees(2 * math.atan(max(width / fx, height / fy) / 2))
    if angle > WIDEST and not lens.is_fisheye:
        raise ValueError(
            f"with a focal length of {fx:g} x {fy:g} pixels, an image of {width} x {height} pixels shows {angle:.0f} "
            f"degrees; expected at most {WIDEST}; f in millimetres must be divided by the size of a pixel in "
            "millimetres"
        )
    require_no_fold(K, lens, width, height)

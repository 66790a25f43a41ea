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
from pydantic import Field, model_validator

from phd_exp.optics.lens import Lens
from phd_exp.optics.virtual import require_no_fold
from phd_exp.records.camera_files import NOT_READ, READ, content_of, entries
from phd_exp.records.errors import DatasetError, gist, listed, shown
from phd_exp.records.files import LARGEST_RECORD, MB, read_plain
from phd_exp.records.parsing import Record, parse_json

CORNER = 0.5  # px from the corner of the first pixel to its centre
LARGEST = 1e6  # of any number in a camera file
WIDEST = 150  # degrees that an image may show, unless through a fisheye
SHORTEST = 0.01  # focal length, px; a shorter one is probably in metres
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

Size = Annotated[int, Field(gt=0)]
Found = dict[str, tuple[str, Any]]
"""Quantity -> its key in the file, and its value."""


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


def read_camera(path: Path) -> Calibration:
    """The calibration in a camera file. Raises DatasetError, one line that names the file, if there is none."""
    try:
        # YAML takes seconds a megabyte
        text = read_plain(path, LARGEST_RECORD if path.suffix == ".json" else MB).decode("utf-8-sig")
        return calibration_in(content_of(text))
    except (OSError, ValueError, LookupError, RecursionError) as error:
        raise DatasetError(f"{path}: {gist(error)}; see `Lenses` in docs/guides/own_images.md") from None


def calibration_in(content: Any, image: tuple[int, int] | None = None) -> Calibration:
    """The calibration in the content of a camera file. Raises ValueError if there is none.

    `image` is the size of the images, where it is known.
    """
    found = _found(content)
    (width, height), (model, D) = _size(found), _lens(found)
    sensor = Calibration(width=width, height=height, K=tuple(_matrix(found)), D=tuple(D), model=model)
    return _read_out(sensor, found, image)


def _read_out(sensor: Calibration, found: Found, image: tuple[int, int] | None) -> Calibration:
    """The camera of the pixels that ROS's region of interest and binning leave of a sensor.

    The region is in pixels of the sensor; a binned pixel covers a rectangle of them. Raises ValueError if the images
    have another size. Some drivers give the size of their images as that of the sensor, which is accepted where the
    principal point is then nearer to the middle.

    Source: the definition of sensor_msgs/CameraInfo.
    """
    region = found.get("roi", ("roi", {}))[1]
    x, y, *cut = (int(_numbers("roi", region.get(key, 0))[0]) for key in ("x_offset", "y_offset", "width", "height"))
    bins = [max(1, int(_numbers(*found.get(f"binning_{axis}", ("", 1)))[0])) for axis in "xy"]
    if not any((x, y, *cut)) and bins == [1, 1]:
        return sensor
    full, whole = sensor.intrinsics, (sensor.width or 0, sensor.height or 0)
    expected = (cut[0] or whole[0]) // bins[0], (cut[1] or whole[1]) // bins[1]
    width, height = image or expected
    K = np.diag([*np.divide(1, bins), 1]) @ (full - [[0, 0, x], [0, 0, y], [0, 0, 0]])
    if image and image != expected:
        nearer, farther = (np.linalg.norm(one[:2, 2] - np.divide(image, 2)) for one in (K, full))
        if image != whole or nearer > farther:
            raise ValueError(
                f"binning {bins[0]} x {bins[1]} and the region of {cut[0]} x {cut[1]} pixels at ({x}, {y}) of "
                f"{whole[0]} x {whole[1]} make no images of {width} x {height}; expected width, height and K of the "
                "whole sensor"
            )
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
    if camera.model != "equidistant":
        require_narrow(camera.K[0], camera.K[4], camera.width, camera.height)
    require_no_fold(camera.intrinsics, camera.lens, camera.width, camera.height)
    return camera


def require_narrow(fx: float, fy: float, width: int, height: int) -> None:
    """Raise ValueError if images show more than `WIDEST`, which only those of a fisheye may."""
    angle = math.degrees(2 * math.atan(max(width / fx, height / fy) / 2))
    if angle > WIDEST:
        raise ValueError(
            f"with a focal length of {fx:g} x {fy:g} pixels, an image of {width} x {height} pixels shows {angle:.0f} "
            f"degrees; expected at most {WIDEST}; f in millimetres must be divided by the size of a pixel in "
            "millimetres"
        )


def _found(content: Any) -> Found:
    """The quantities of a file. Raises ValueError if one has two values, or there is no focal length."""
    values = list(entries(content))
    keys = list(dict(values))
    if known := [text for name, text in NOT_READ.items() if any(name in key for key in keys)]:
        raise ValueError(known[0])
    names = [_quantity(key, value) for key, value in values]
    if not {"K", "fx"} & set(names):
        raise ValueError(f"no camera matrix: found {listed(keys) or 'no keys'}; expected {READ}")
    found: Found = {}
    for name, (key, given) in zip(names, values, strict=True):
        value = _model(key, given) if name == "model" else given
        if name and value != "" and found.setdefault(name, (key, value))[1] != value:
            raise ValueError(f"{found[name][0]} and {key} differ; expected the calibration of one camera alone")
    return found


def _quantity(key: str, value: Any) -> str | None:
    """The quantity with a key, if it is one. Raises ValueError for a part of a lens that is none."""
    *outer, name = map(_plain, key.split("."))
    is_list = isinstance(value, list | dict)
    quantity = _QUANTITIES.get(name)
    if (quantity in ("K", "D") and isinstance(value, int | float)) or (
        quantity == "roi" and not isinstance(value, dict)
    ):
        return None
    of_a_lens = _COEFFICIENT.fullmatch(name) or any(map(_LENS.search, [*outer, name] if is_list else outer))
    if quantity is None and of_a_lens and not isinstance(value, str) and re.search("[1-9]", str(value)):
        raise ValueError(f"{key}: got {shown(value)}, a part of a lens that is not supported; expected zero")
    return quantity


def _plain(name: Any) -> str:
    return re.sub(r"[^a-z\d]", "", str(name).lower())


def _model(key: str, value: Any) -> str:
    model = _MODELS.get(_plain(value))
    if model is None:
        raise ValueError(f"{key}: got {shown(value)}; expected {', '.join(COEFFICIENTS)}, or another name of these")
    return model


def _numbers(key: str, value: Any) -> list[float]:
    """The numbers of a list, of nested lists, or of a matrix with rows, cols and data; or one number."""
    if isinstance(value, dict):
        numbers, sizes = _numbers(key, value["data"]), value.get("sizes", [value.get("rows"), value.get("cols")])
        if None not in sizes and math.prod(map(int, sizes)) != len(numbers):
            raise ValueError(f"{key}: got {len(numbers)} numbers in data; expected rows x cols = {sizes}")
        return numbers
    if isinstance(value, str) and value.startswith("["):  # a matrix in quotation marks
        value = parse_json(value)
    if isinstance(value, list):
        return [number for item in value for number in _numbers(key, item)]
    try:
        number = float(value)  # of a text too: 1e-05 is one to PyYAML
        if abs(number) <= LARGEST:
            return [number]
    except (TypeError, ValueError):
        pass
    raise ValueError(f"{key}: got {shown(value)}; expected numbers up to {LARGEST:.0f}")


def _size(found: Found) -> list[Any]:
    """Width and height; None if the file has none."""
    if "size" not in found:
        return [found.get(name, ("", None))[1] for name in ("width", "height")]
    size = _numbers(*found["size"])
    if len(size) != 2:
        raise ValueError(f"{found['size'][0]}: got {size}; expected width and height")
    return size


def _matrix(found: Found) -> list[float]:
    """K by rows. COLMAP and nerfstudio, which name the focal length fl_x, count pixels from the corner."""
    K, names = _numbers(*found["K"]) if "K" in found else [], ("fx", "fy", "cx", "cy")
    if "fx" not in found and len(K) != 4:
        return K
    if missing := [name for name in names if len(K) != 4 and name not in found]:
        raise ValueError(f"{missing[0]} is missing: found {listed([key for key, _ in found.values()])}")
    fx, fy, cx, cy = K if len(K) == 4 else (_numbers(*found[name])[0] for name in names)
    centre = CORNER if "fl" in found.get("fx", ("",))[0].lower() else 0.0
    rows = [fx, 0.0, cx - centre, 0.0, fy, cy - centre, 0.0, 0.0, 1.0]
    if len(K) == 9 and rows != K:
        raise ValueError(f"{found['K'][0]} and {found['fx'][0]} differ; expected the calibration of one camera alone")
    return rows


def _lens(found: Found) -> tuple[Any, list[float]]:
    """The model, and its coefficients, with zeros for those that the file leaves out."""
    D = _numbers(*found["D"]) if "D" in found else []
    named = {name: _numbers(*found[name])[0] for name in COEFFICIENTS["rational_polynomial"] if name in found}
    if D and any(named.values()):
        raise ValueError(f"{found['D'][0]} and {', '.join(named)} are two lenses; expected one")
    flag = str(found["fisheye"][1]).lower() in ("1", "1.0", "true") if "fisheye" in found else None
    model = found.get("model", ("", "equidistant" if flag else None))[1]
    if model in COEFFICIENTS and not (named or "D" in found):
        raise ValueError(f"no coefficients of {model}: found {listed([key for key, _ in found.values()])}")
    if not any([*D, *named.values()]):
        model = model if model in COEFFICIENTS else "plumb_bob"
    model = model or _only_model(D, named, is_pinhole=flag is False or bool(named.keys() & {"p1", "p2"}))
    names = COEFFICIENTS.get(model, ())
    given = dict(zip([*names, *map(str, range(len(D)))], D, strict=False)) if D else named
    is_short = any(D[2:3] if model == "plumb_bob" else D) and len(D) < 4  # k3 or p1; or another model's
    if is_short or any(value for name, value in given.items() if name not in names):
        expected = f"{', '.join(names) or 'none'} for {model}, zero beyond"
        raise ValueError(f"coefficients: got {D or named}; expected {expected}")
    return model, [given.get(name, 0.0) for name in names]


def _only_model(D: list[float], named: dict[str, float], is_pinhole: bool) -> str:
    """The only model with coefficients of these names, or so many. Raises ValueError if there are two."""
    if len(D) in (8, 12, 14) or (is_pinhole and "k6" in named):
        return "rational_polynomial"
    if len(D) == 5 or (is_pinhole and len(D) <= 4):
        return "plumb_bob"
    count = f"{len(D or named)} coefficients of no model"
    raise ValueError(f"{count}; add distortion_model: plumb_bob (k1, k2, p1, p2) or equidistant (k1, k2, k3, k4)")

"""Camera files: intrinsics and lens of a camera, in the YAML of ROS (`camera_info`) or OpenCV (`FileStorage`)."""

import re
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AliasChoices, BeforeValidator, Field, model_validator

from phd_exp.records.errors import DatasetError, gist
from phd_exp.records.files import MB, read_plain
from phd_exp.records.parsing import Record, parse_yaml

SHORTEST = 0.01  # focal length, px; a shorter one is probably in metres
Model = Literal["plumb_bob", "rational_polynomial", "equidistant"]
COUNTS = {"plumb_bob": (0, 4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (4,)}
"""Numbers of coefficients; those after the eighth are of a thin prism and a tilted sensor."""


def _values(matrix: Any) -> Any:
    if not isinstance(matrix, dict):
        return matrix
    values, sizes = matrix.get("data"), matrix.get("sizes", [matrix.get("rows"), matrix.get("cols")])
    if not isinstance(values, list) or sizes not in ([3, 3], [1, len(values)], [len(values), 1], [len(values)]):
        raise ValueError(f"expected as many numbers in data as rows x cols; rows and cols are {sizes}")
    return values


def _of_opencv(values: dict[str, Any]) -> Model:
    few = len(values.get("D", ())) < 8
    return "equidistant" if values.get("fisheye_model") else "plumb_bob" if few else "rational_polynomial"


Size = Annotated[int, Field(gt=0)]
Value = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]  # not strict: 1e-05 is a text to PyYAML
Matrix = Annotated[tuple[Value, ...], BeforeValidator(_values)]


class Calibration(Record, extra="ignore"):
    """The content of a camera file, where the centre of the first pixel is (0, 0).

    Attributes:
        width, height: of the images, px; not in every file of OpenCV.
        K: camera matrix, row by row, px.
        D: k1, k2, p1, p2, k3 to k6; or k1 to k4 of a fisheye.
        fisheye_model, model: of the distortion, as OpenCV's calibration program and ROS name it.
    """

    width: Size | None = Field(None, validation_alias=AliasChoices("image_width", "width"))
    height: Size | None = Field(None, validation_alias=AliasChoices("image_height", "height"))
    K: Matrix = Field(validation_alias=AliasChoices("camera_matrix", "K", "k"))
    D: Matrix = Field(validation_alias=AliasChoices("distortion_coefficients", "D", "d"))
    fisheye_model: bool = False
    model: Model = Field(validation_alias="distortion_model", default_factory=_of_opencv)

    @model_validator(mode="after")
    def belongs_together(self) -> "Calibration":
        """Refuse skew, and coefficients that do not fit the model."""
        K, n = self.K, COUNTS[self.model]
        if len(K) != 9 or min(K[0], K[4]) < SHORTEST or (K[1], K[3], *K[6:]) != (0, 0, 0, 0, 1):
            raise ValueError(f"camera_matrix: got {list(K)}; expected [fx, 0, cx, 0, fy, cy, 0, 0, 1] in pixels")
        if len(self.D) not in n or any(self.D[8:]):
            raise ValueError(
                f"distortion_coefficients: got {list(self.D)}; expected {' or '.join(map(str, n))} for {self.model}, "
                "zero from the ninth on (no thin prism, no tilted sensor)"
            )
        return self


def read_camera(path: Path) -> Calibration:
    """The calibration in a camera file. Raises DatasetError, one line that names the file, if there is none."""
    try:
        values = parse_yaml(re.sub(r"\A%YAML.*|!!opencv-(nd-)?matrix", "", read_plain(path, MB).decode()))
        if isinstance(values, dict) and "D" in values:  # of cv2.calibrateCamera, or of cv2.fisheye?
            values = {"distortion_model": None} | values
        return Calibration.model_validate(values)
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path}: {gist(error)}; expected YAML of ROS (camera_info) or OpenCV") from None

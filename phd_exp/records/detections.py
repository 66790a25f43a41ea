"""One detection in the user's own images: its image, camera and true position, a line of `metadata.jsonl`."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from os import fsencode
from os.path import commonpath
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from pydantic import Field, PlainValidator, ValidationError, model_validator

from phd_exp.optics.lens import PINHOLE, Lens
from phd_exp.optics.virtual import intrinsics
from phd_exp.records.cameras import SHORTEST, Calibration, Size, read_camera, require_possible
from phd_exp.records.errors import DatasetError, complaint
from phd_exp.records.images import content_of
from phd_exp.records.parsing import Record
from phd_exp.records.scenes import Pose, SampleRecord
from phd_exp.records.spec import Number, Positive

DISTORTION = re.compile(r"[kp][1-8]|.*distort.*|dist(_?coeff.*)?|.*fisheye.*", re.IGNORECASE)
NORMALISED = 1.5  # px; the largest right or bottom of a box in units of the image, even of one by its middle
NEAREST = 0.005  # m from the camera to the nearest object
LARGEST_BOX = 3
"""Sides of a box over the longer side of its image; the part outside the image is grey and holds no information."""


def _name(value: Any) -> int | str:
    if isinstance(value, bool) or not isinstance(value, int | str) or value == "":
        raise ValueError("expected a whole number or a name")
    return value


FileName = Annotated[str, Field(min_length=1, max_length=1000)]
NumberOrName = Annotated[int | str, PlainValidator(_name)]
Pixels = Annotated[Number, Field(ge=-1e6, le=1e6)]
FocalLength = Annotated[Number, Field(ge=SHORTEST, le=1e6)]  # px
Metres = Annotated[Number, Field(ge=-1e6, le=1e6)]


class DetectionLine(Record):
    """One line of `metadata.jsonl`; pixels count from the top left corner of the stored image.

    Attributes:
        file_name: the image, relative to the folder of the line's file.
        f: focal length, px; or fx and fy if pixels are not square.
        cx, cy: principal point, px; by default the middle of the image.
        width, height: of the image, px; checked.
        camera: instead of these, a camera file, relative to the folder of the line's file.
        box: left, top, right, bottom of the detection, px; by default the whole image.
        score, category_id: of the detector; `predict` repeats them.
        x, y, z: true position in the camera frame (x right, y down, z forward), m.
        scale, visibility, truncation: as in a rendered data set; recorded with the predictions.
        scene: lines with the same scene show the same object at the same time.
        pose: of the camera, in the world that the cameras of a scene, or the frames of a track, share.
        time: of the image, s; lines with the same track show the same object at different times.
    """

    file_name: FileName
    f: FocalLength | None = None
    fx: FocalLength | None = None
    fy: FocalLength | None = None
    cx: Pixels | None = None
    cy: Pixels | None = None
    width: Size | None = None
    height: Size | None = None
    camera: FileName | None = None
    box: tuple[Pixels, Pixels, Pixels, Pixels] | None = None
    score: Number | None = None
    category_id: NumberOrName | None = None
    x: Metres | None = None
    y: Metres | None = None
    z: Metres | None = None
    scale: Positive | None = None
    visibility: Annotated[Number, Field(ge=0, le=1)] | None = None
    truncation: Annotated[Number, Field(ge=0, le=1)] | None = None
    scene: NumberOrName | None = None
    pose: Pose | None = None
    time: Number | None = None
    track: NumberOrName | None = None

    @model_validator(mode="before")
    @classmethod
    def leave_out_what_a_renderer_adds(cls, values: Any) -> Any:
        """Ignore the other keys of a rendered data set; any other unknown key is an error."""
        if not isinstance(values, dict):
            return values
        ignored = SampleRecord.model_fields.keys() - cls.model_fields.keys()
        return {key: value for key, value in values.items() if key not in ignored}

    @model_validator(mode="after")
    def belongs_together(self) -> "DetectionLine":
        """Refuse half a camera, half a position, and an empty box."""
        cameras = [given for given in (self.f, self.fx or self.fy, self.camera) if given]
        if len(cameras) != 1 or (self.camera and self.cx is not None):
            raise ValueError("expected either f, or fx and fy (focal length in pixels), or camera (a file) alone")
        if not self.camera and self.z is not None and self.z <= 0:  # a fisheye may show what is behind
            raise ValueError(f"z: got {self.z:g}; expected to be greater than 0")
        for names in (("fx", "fy"), ("cx", "cy"), ("width", "height"), ("x", "y", "z")):
            given = [name for name in names if getattr(self, name) is not None]
            if 0 < len(given) < len(names):
                raise ValueError(f"{', '.join(given)} is given alone; expected all of {', '.join(names)}")
        if self.z is not None and math.hypot(self.x or 0, self.y or 0, self.z) < NEAREST:
            raise ValueError(
                f"x, y, z: got a position {self.z:g} m from the camera; expected metres, and at least {NEAREST:g} m; "
                "of BOP, expected cam_t_m2c in millimetres"
            )
        if self.box and not (self.box[0] < self.box[2] and self.box[1] < self.box[3]):
            raise ValueError(f"box={list(self.box)}: expected [left, top, right, bottom] of positive size")
        return self


@dataclass(frozen=True)
class RecordedImage:
    """An image of a recording: the bytes of an image file, its time (ns), and the name of its camera's frame."""

    content: bytes
    time: int
    frame: str


@dataclass(frozen=True)
class Detection:
    """One line, the image that it names, the place of the line, for messages, and the content of its camera file.

    The `file` of a `recorded` image is its place in the recording, and no file on disk.
    """

    line: DetectionLine
    file: Path
    where: str
    calibration: Calibration | None = None
    recorded: RecordedImage | None = None

    @property
    def content(self) -> bytes:
        """The bytes of the image file. Raises DatasetError if it cannot be read."""
        return self.recorded.content if self.recorded else content_of(self.file)

    @property
    def position(self) -> tuple[float, float, float]:
        """True position in the frame of the real camera, m. Raises DatasetError if the line has none."""
        x, y, z = self.line.x, self.line.y, self.line.z
        if x is None or y is None or z is None:
            raise DatasetError(f"{self.where}: x, y, z are missing; training and testing need the true position")
        return x, y, z

    def optics(self, width: int, height: int) -> tuple[Float[np.ndarray, "3 3"], Lens]:
        """The camera matrix (px from the corner of the first pixel) and the lens, for an image of that size, px.

        Raises DatasetError if the line or the camera file is for another size, the image would show too much, or its
        lens folds over inside.
        """
        line, file = self.line, self.calibration
        for name, given in (("", line), (f"camera={line.camera}: ", file)):
            if given and (given.width or width, given.height or height) != (width, height):
                raise DatasetError(
                    f"{self.where}: {name}is for images of {given.width} x {given.height} pixels; this image has "
                    f"{width} x {height}; scale image, size, camera and boxes alike"
                )
        fx, fy = line.f or line.fx or 0.0, line.f or line.fy or 0.0  # a line without a file has f or both
        cx, cy = width / 2 if line.cx is None else line.cx, height / 2 if line.cy is None else line.cy
        K, lens = (file.intrinsics, file.lens) if file else (intrinsics(fx, fy, cx, cy), PINHOLE)
        try:
            require_possible(K, lens, width, height)
        except ValueError as error:
            raise DatasetError(f"{self.where}: {error}") from None
        return K, lens

    def box(self, width: int, height: int) -> tuple[float, float, float, float]:
        """The box in an image of that size, px. Raises DatasetError if it lies outside the image or is too large."""
        if self.line.box is None:
            return 0.0, 0.0, float(width), float(height)
        left, top, right, bottom = self.line.box
        larger = max(width, height)
        faults = {
            "seems to be in units of the image; expected pixels of": max(right, bottom) <= NORMALISED < larger,
            "lies outside": left >= width or top >= height or right <= 0 or bottom <= 0,
            f"is more than {LARGEST_BOX} times as large as": max(right - left, bottom - top) > LARGEST_BOX * larger,
        }
        for fault in (fault for fault, is_there in faults.items() if is_there):
            raise DatasetError(f"{self.where}: box={[*self.line.box]} {fault} the image of {width} x {height} pixels")
        return left, top, right, bottom


def detections_of(
    files: Sequence[Path], camera: Mapping[str, Any], boxes: Sequence[Mapping[str, Any]] = ({},)
) -> list[Detection]:
    """The detections in image files of one camera, with values as in lines of `metadata.jsonl`: all boxes in each.

    The names of the files begin where their folders differ. Raises DatasetError if the values are not a detection.

    Examples:
        >>> (detection,) = detections_of([Path("photo.jpg")], {"f": 900.0})
        >>> K, lens = detection.optics(640, 480)
        >>> K[:2, 2].tolist()
        [320.0, 240.0]
    """
    named = [({"file_name": name, **camera}, file) for name, file in zip(_names(files), files, strict=True)]
    lines = [(line_of({**values, **box}, str(file)), file) for values, file in named for box in boxes]
    calibration = read_camera(Path(camera["camera"])) if "camera" in camera else None
    return [Detection(line, file, str(file), calibration) for line, file in lines]


def named_apart(detections: Sequence[Detection]) -> list[Detection]:
    """Detections of several folders, whose `file_name` begins where the folders differ."""
    names = _names([one.file for one in detections])
    lines = [one.line.model_copy(update={"file_name": name}) for one, name in zip(detections, names, strict=True)]
    return [replace(one, line=line) for one, line in zip(detections, lines, strict=True)]


def _names(files: Sequence[Path]) -> list[str]:
    """The names from where folders differ; what is not UTF-8 is written as \\x.., because JSON holds only text."""
    folder = commonpath([file.absolute().parent for file in files])
    return [fsencode(file.absolute().relative_to(folder)).decode(errors="backslashreplace") for file in files]


def line_of(values: Any, where: str) -> DetectionLine:
    """The line with these values. Raises DatasetError, naming `where`, if they are not one."""
    try:
        return DetectionLine.model_validate(values)
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        is_of_lens = problem["type"] == "extra_forbidden" and DISTORTION.fullmatch(key := str(problem["loc"][-1]))
        advice = f"{key}: a line describes no lens; expected camera, a calibration file" if is_of_lens else ""
        raise DatasetError(f"{where}: {advice or complaint(problem, DetectionLine)}") from None

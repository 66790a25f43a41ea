"""The user's own images: `metadata.jsonl` says of each detection which image shows it, by what camera, and where.

    <folder>/
        <split>/metadata.jsonl    one JSON object a line
        <split>/...               the images, beside it or in folders below
        .cache/                   crops, decoded once

`DetectionLine` says what a line may hold.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    PlainValidator,
    ValidationError,
    model_validator,
)
from pydantic_core import ErrorDetails

from phd_exp.records.dataset import SPLITS, checksum, sha256
from phd_exp.records.errors import UNPRINTABLE, DatasetError, gist, in_our_words, nearest, shown
from phd_exp.records.files import read_jsonl
from phd_exp.records.parsing import parse_json
from phd_exp.records.scenes import Pose, SampleRecord, Split
from phd_exp.records.spec import Number, Positive

DISTORTION = re.compile(r"[kp][1-8]|.*distort.*|dist(_?coeff.*)?|.*fisheye.*", re.IGNORECASE)
SHORTEST = 0.01
"""Focal length, px; what is shorter was meant in metres, or is none."""
LARGEST_BOX = 3
"""Sides of a box over the longer side of its image; what lies outside the image is grey and tells nothing."""


def _name(value: Any) -> int | str:
    if isinstance(value, bool) or not isinstance(value, int | str) or value == "":
        raise ValueError("expected a whole number or a name")
    return value


def _in_pixels(f: float) -> float:
    if f < SHORTEST:
        raise ValueError(f"expected a focal length in pixels, at least {SHORTEST}")
    return f


SceneName = Annotated[int | str, PlainValidator(_name)]
Pixels = Annotated[Number, Field(ge=-1e6, le=1e6)]
FocalLength = Annotated[Positive, Field(le=1e6), AfterValidator(_in_pixels)]
Metres = Annotated[Number, Field(ge=-1e6, le=1e6)]


class DetectionLine(BaseModel):
    """One line of `metadata.jsonl`; pixels count from the top left corner of the image file as it is stored.

    Attributes:
        file_name: the image, relative to the folder of the line's own file.
        f: focal length, px; or fx and fy where a pixel is not square.
        cx, cy: principal point, px; the middle of the image by default.
        box: left, top, right, bottom of the detection, px; the whole image by default.
        x, y, z: true position in the frame of the camera (x right, y down, z forward), m.
        scale, visibility: as in a rendered data set; recorded beside the predictions.
        scene: lines of one scene show the same object at the same time.
        pose: of the camera in the world that the scene's cameras share.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    file_name: Annotated[str, Field(min_length=1, max_length=1000)]
    f: FocalLength | None = None
    fx: FocalLength | None = None
    fy: FocalLength | None = None
    cx: Pixels | None = None
    cy: Pixels | None = None
    box: tuple[Pixels, Pixels, Pixels, Pixels] | None = None
    x: Metres | None = None
    y: Metres | None = None
    z: Annotated[Number, Field(ge=1e-6, le=1e6)] | None = None
    scale: Positive | None = None
    visibility: Annotated[Number, Field(ge=0, le=1)] | None = None
    scene: SceneName | None = None
    pose: Pose | None = None

    @model_validator(mode="before")
    @classmethod
    def leave_out_what_a_renderer_adds(cls, values: Any) -> Any:
        """A rendered data set can be read as it is; of all other keys, each must mean something."""
        if not isinstance(values, dict):
            return values
        ignored = SampleRecord.model_fields.keys() - cls.model_fields.keys()
        return {key: value for key, value in values.items() if key not in ignored}

    @model_validator(mode="after")
    def belongs_together(self) -> "DetectionLine":
        """Refuse half a camera, half a position, and a box without an inside."""
        if (self.f is None) == (self.fx is None and self.fy is None):
            raise ValueError("expected either f, or fx and fy (focal length in pixels)")
        for names in (("fx", "fy"), ("cx", "cy"), ("x", "y", "z")):
            given = [name for name in names if getattr(self, name) is not None]
            if 0 < len(given) < len(names):
                raise ValueError(f"{', '.join(given)} is given alone; expected all of {', '.join(names)}")
        if self.box and not (self.box[0] < self.box[2] and self.box[1] < self.box[3]):
            raise ValueError(f"box={list(self.box)}: expected [left, top, right, bottom] of positive size")
        return self


@dataclass(frozen=True)
class Detection:
    """One line, the image that it names, and where the line itself stands, for messages."""

    line: DetectionLine
    file: Path
    where: str

    @property
    def position(self) -> tuple[float, float, float]:
        """True position, frame of the real camera, m. Raises DatasetError where the line has none."""
        x, y, z = self.line.x, self.line.y, self.line.z
        if x is None or y is None or z is None:
            raise DatasetError(
                f"{self.where}: x, y, z are missing; training and testing need the true position"
            )
        return x, y, z

    def focal_lengths_and_centre(self, width: int, height: int) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy of an image of that size, px."""
        line = self.line
        fx, fy = (
            value for value in (line.f or line.fx, line.f or line.fy) if value
        )  # never zero nor missing
        cx = width / 2 if line.cx is None else line.cx
        cy = height / 2 if line.cy is None else line.cy
        return fx, fy, cx, cy

    def require_in_sight(self, width: int, height: int) -> None:
        """Raise DatasetError where the position projects further beyond the image than an object in it reaches."""
        x, y, z = self.position
        fx, fy, cx, cy = self.focal_lengths_and_centre(width, height)
        column, row = cx + fx * x / z, cy + fy * y / z
        longest = LARGEST_BOX * max(width, height)
        if abs(column - width / 2) > longest or abs(row - height / 2) > longest:
            raise DatasetError(
                f"{self.where}: the position {[x, y, z]} is seen at [{column:.0f}, {row:.0f}], far outside the image "
                f"of {width} x {height} pixels; check x, y, z (metres) and the focal length (pixels)"
            )

    def box(self, width: int, height: int) -> tuple[float, float, float, float]:
        """The box in an image of that size, px. Raises DatasetError where the image shows nothing of it."""
        if self.line.box is None:
            return 0.0, 0.0, float(width), float(height)
        left, top, right, bottom = self.line.box
        if left >= width or top >= height or right <= 0 or bottom <= 0:
            raise DatasetError(
                f"{self.where}: box={list(self.line.box)} lies outside the image of {width} x {height} pixels"
            )
        longest = LARGEST_BOX * max(width, height)
        if right - left > longest or bottom - top > longest:
            raise DatasetError(
                f"{self.where}: box={list(self.line.box)} is more than {LARGEST_BOX} times as large as "
                f"the image of {width} x {height} pixels"
            )
        return left, top, right, bottom


@dataclass(frozen=True)
class DetectionFolder:
    """A folder of the user's own images, with a sub-folder for each split."""

    root: Path

    @property
    def cache(self) -> Path:
        """Where decoded crops are kept."""
        return self.root / ".cache"

    def metadata_path(self, split: Split) -> Path:
        """The lines of a split."""
        return self.root / split / "metadata.jsonl"

    def detections(self, split: Split, n: int | None = None) -> list[Detection]:
        """The first n detections of a split (all by default), in the order of the lines.

        Raises:
            DatasetError: the file cannot be read, a line is not a detection, or there are fewer than n.
            CorruptFileError: a line is not text.
        """
        return detections_in(self.root / split, n, f" (data.n_{split})")

    def fingerprint(self) -> str:
        """Checksum of what is said of all images, though not of the images themselves.

        Raises:
            OSError: a `metadata.jsonl` cannot be read.
        """
        return sha256("".join(checksum(self.metadata_path(split)) for split in SPLITS).encode())


def detections_in(folder: Path, n: int | None = None, asked_by: str = "") -> list[Detection]:
    """The first n detections (all by default) of one folder's `metadata.jsonl`, in the order of the lines.

    Raises:
        DatasetError: the file cannot be read, a line is not a detection, or there are fewer than n.
        CorruptFileError: a line is not text.
    """
    path = folder / "metadata.jsonl"
    try:
        lines = read_jsonl(path, str.strip, sealed=True)
    except OSError as error:
        raise DatasetError(
            f"{path}: cannot be read ({error.strerror}); expected one JSON object a line, "
            "see `Your own images` in README.md"
        ) from None
    numbered = [(number, text) for number, text in enumerate(lines, start=1) if text][:n]
    if not numbered or len(numbered) < (n or 0):
        raise DatasetError(f"{path}: {n or 'some'} detections asked for{asked_by}, {len(numbered)} found")
    return [_detection(folder, text, f"{path}, line {number}") for number, text in numbered]


def detection_of(file: Path, values: Mapping[str, Any]) -> Detection:
    """A detection in one image file, from values as a line of `metadata.jsonl` has them. Raises DatasetError."""
    return Detection(_line({"file_name": file.name, **values}, str(file)), file, str(file))


def _detection(folder: Path, text: str, where: str) -> Detection:
    try:
        values = parse_json(text)
    except ValueError as error:
        raise DatasetError(f"{where}: not JSON ({error}); expected one object a line") from None
    line = _line(values, where)
    return Detection(line, _inside(folder, line.file_name, where), where)


def _line(values: Any, where: str) -> DetectionLine:
    try:
        return DetectionLine.model_validate(values)
    except ValidationError as error:
        raise DatasetError(f"{where}: {_complaint(error.errors(include_url=False)[0])}") from None


def _inside(folder: Path, name: str, where: str) -> Path:
    """The image file; a data set from somebody else must not read what lies elsewhere."""
    if UNPRINTABLE.search(name):  # it would end the line of a message, or steer the terminal
        raise DatasetError(f"{where}: file_name={shown(name)} is no file name (control characters)")
    try:
        leaves = Path(name).is_absolute() or ".." in Path(name).parts
        leaves = leaves or not (folder / name).resolve().is_relative_to(folder.resolve())
    except (ValueError, OSError, RuntimeError) as error:  # a link that leads to itself, a name without end
        raise DatasetError(f"{where}: file_name={shown(name)} is no file name ({gist(error)})") from None
    if leaves:
        raise DatasetError(f"{where}: file_name={name!r} leaves {folder}; expected a path below it")
    return folder / name


def _complaint(problem: ErrorDetails) -> str:
    """What is wrong with a line: the key, the value, what was expected."""
    key = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "extra_forbidden" and DISTORTION.fullmatch(key):
        return (
            f"{key}: a distorted image is no pinhole image; undistort the images first, then leave out {key}"
        )
    if problem["type"] == "extra_forbidden":
        known = (Pose if key.startswith("pose.") else DetectionLine).model_fields
        return f"{key}: unknown key{nearest(key, known)}; expected one of {', '.join(known)}"
    if problem["type"] == "missing":
        return f"{key}: missing"
    if not key:  # of the whole line
        return in_our_words(problem["msg"])
    return f"{key}: got {shown(problem['input'])}; {in_our_words(problem['msg'])}"

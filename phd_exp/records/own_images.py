"""The user's own images: `metadata.jsonl` lists detections, each with its image, camera and true position.

    <folder>/
        <split>/metadata.jsonl    one JSON object per line
        <split>/...               the images, next to it or in subfolders
        .cache/                   crops, decoded once

`DetectionLine` describes a line. Lines with the same `scene` form one `Observed`. A folder without
`metadata.jsonl` may have annotations in another format (`foreign.py`), which become lines too.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from phd_exp.records.cameras import Calibration, read_camera
from phd_exp.records.dataset import sha256
from phd_exp.records.detections import Detection, line_of
from phd_exp.records.errors import CONTROLS, DatasetError, listed, reading, shown
from phd_exp.records.files import checksum, read_jsonl
from phd_exp.records.foreign import Entry, expected_in, format_of
from phd_exp.records.images import SUFFIXES
from phd_exp.records.parsing import parse_json
from phd_exp.records.scenes import Pose, Split

ONE_A_LINE = "expected one object a line"


@dataclass(frozen=True)
class DetectionFolder:
    """A folder of the user's own images, with a subfolder for each split; `object_name` selects detections."""

    root: Path
    object_name: int | str | None = None

    @property
    def cache(self) -> Path:
        """The folder of decoded crops."""
        return self.root / ".cache"

    def detections(self, split: Split, n: int | None = None) -> list[Detection]:
        """The detections of a split, as `detections_in` reads them."""
        return detections_in(self.root / split, n, f" (data.n_{split})", self.object_name)


def fingerprint(*folders: Path) -> str:
    """Checksum of the annotations of folders and of the camera files that they name, without the images.

    Raises OSError if a file cannot be read, DatasetError if a line is not JSON.
    """
    sums: list[str] = []
    for folder in folders:
        files, read = annotations(folder)
        sums += map(checksum, files)
        lines = [values for _, _, values in read(folder) if isinstance(values, dict)] if read is _entries else []
        names = sorted({line["camera"] for line in lines if isinstance(line.get("camera"), str)})
        sums += [checksum(_inside(folder, name, str(files[0]), "camera")) for name in names]
    return sha256("".join(sums).encode())


def detections_in(
    folder: Path, n: int | None = None, asked_by: str = "", object_name: int | str | None = None
) -> list[Detection]:
    """The first n detections of a folder's annotations, all by default, in their order.

    `object_name` selects those of one object: BOP's `obj_id` or COCO's category.

    Raises:
        DatasetError: a file cannot be read, an entry is not a detection, there are fewer than n, or no such object.
        CorruptFileError: a line is not text.
    """
    found: list[Detection] = []
    cameras: dict[str, Calibration] = {}
    others = set()
    files, read = annotations(folder)
    for where, name, values in read(folder):
        if object_name is not None and name != str(object_name):
            others.add(name)
            continue
        line = line_of(values, where)
        if line.camera and line.camera not in cameras:
            cameras[line.camera] = read_camera(_inside(folder, line.camera, where, "camera"))
        file = _inside(folder, line.file_name, where)
        found.append(Detection(line, file, where, cameras.get(line.camera or "")))
        if len(found) == n:
            break
    if others and not found:
        names = f"one of {listed(sorted(others))}" if all(others) else "no object=, since metadata.jsonl names none"
        raise DatasetError(f"{folder}: no object {shown(str(object_name))} here; expected {names}")
    if not found or len(found) < (n or 0):
        raise DatasetError(f"{files[0]}: {n or 'some'} detections asked for{asked_by}, {len(found)} found")
    return found


def images_in(folder: Path) -> list[Path]:
    """The image files of a folder, sorted by name. Raises DatasetError if it has annotations, or no images."""
    described = annotations(folder)[0][0]
    if os.path.lexists(described):
        raise DatasetError(f"{folder}: has annotations, {described}; expected images alone, or no f= and camera=")
    if files := sorted(file for file in folder.glob("*") if file.suffix.lower() in SUFFIXES):
        return files
    raise DatasetError(f"{folder}: no images; expected a folder with files *{', *'.join(SUFFIXES)}")


def annotations(folder: Path) -> tuple[list[Path], Callable[[Path], Iterator[Entry]]]:
    """The files that describe a folder's images, and their reader; `metadata.jsonl` comes before other formats."""
    metadata = folder / "metadata.jsonl"
    return (not os.path.lexists(metadata) and format_of(folder)) or ([metadata], _entries)


def _entries(folder: Path) -> Iterator[Entry]:
    path = folder / "metadata.jsonl"
    if not os.path.lexists(path):
        raise DatasetError(f"{folder}: {expected_in(folder)}")
    with reading(path, ONE_A_LINE):
        lines = read_jsonl(path, lambda text: text.removeprefix("\ufeff").strip(), sealed=True)
    for number, text in enumerate(lines, start=1):
        with reading(where := f"{path}, line {number}", ONE_A_LINE, what="not JSON"):
            if text:
                yield where, "", parse_json(text)


@dataclass(frozen=True)
class Observed:
    """One scene: at least one detection of its object, and the pose of each detection's camera."""

    scene: int | str
    detections: tuple[Detection, ...]
    poses: tuple[Pose, ...]


def views_of(scenes: Sequence[Observed]) -> Iterator[tuple[int, int, Observed]]:
    """For each detection of all scenes, one scene after the other: numbers of scene and camera, and the scene."""
    return ((number, k, scene) for number, scene in enumerate(scenes) for k in range(len(scene.detections)))


def observed(detections: Sequence[Detection]) -> list[Observed]:
    """The scenes of detections, in the order in which they first appear.

    Raises DatasetError if a line has no scene, or no pose.
    """
    views: dict[int | str, list[tuple[Detection, Pose]]] = {}
    for detection in detections:
        scene, pose = detection.line.scene, detection.line.pose
        if scene is None or pose is None:
            raise DatasetError(
                f"{detection.where}: scene or pose is missing; expected the same scene, a number or name, on all "
                "lines that show the same object at the same time, and the pose of the camera: the rotation "
                "[w, x, y, z] and translation of R v + t from the world to the camera"
            )
        views.setdefault(scene, []).append((detection, pose))
    return [Observed(scene, *map(tuple, zip(*pairs, strict=True))) for scene, pairs in views.items()]


def tracks_of(detections: Sequence[Detection]) -> dict[int | str | None, list[Detection]]:
    """Name -> detections of each track, in the order of the lines; None for lines without a track."""
    tracks: dict[int | str | None, list[Detection]] = {}
    for detection in detections:
        tracks.setdefault(detection.line.track, []).append(detection)
    return tracks


def _inside(folder: Path, name: str, where: str, key: str = "file_name") -> Path:
    """The file; a stranger's data set must not read files outside its folder."""
    with reading(where, what=f"{key}={shown(name)} is no file name"):  # also a link to itself, or too long a name
        if CONTROLS.search(name):
            raise ValueError("control characters")
        is_below = (folder / name).resolve().is_relative_to(folder.resolve())
        if not is_below or ".." in Path(name).parts or Path(name).is_absolute():
            raise ValueError(f"leaves {folder}; expected a path below it")
    return folder / name

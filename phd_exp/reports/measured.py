"""Measures a run's predictions inside one boundary, and stores the result until the run changes."""

import hashlib
import json
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from pydantic import TypeAdapter

from phd_exp.distributions.temperature import Temperature
from phd_exp.evaluation.conformal import conformal_log_volumes
from phd_exp.evaluation.fusion import FusionScores, fusion_scores, two_cameras
from phd_exp.evaluation.parquet import Arrays
from phd_exp.evaluation.predictions import Evaluation, evaluate, fit_temperature, recalibrated
from phd_exp.evaluation.several_views import read_sequences, read_views
from phd_exp.evaluation.shifts import ShiftScores, shift_scores
from phd_exp.evaluation.tracks import TrackScores, choose, track_scores
from phd_exp.records.errors import RunError, UserError, one_line
from phd_exp.records.files import beginning, write_atomic
from phd_exp.records.runs import HELD_OUT, RunFolder
from phd_exp.reports.gallery import Gallery, images_folder, make_gallery
from phd_exp.reports.scene import Scene, first_scene
from phd_exp.reports.table import file_stem

Found = TypeVar("Found")

VERSIONS = {
    "before": 4,
    "after": 6,
    "fusion": 1,
    "pairs": 1,
    "tracks": 4,
    "gallery": 2,
    "scene": 1,
    "shifts": 1,
    "ensembles": 1,
}
"""Measurement -> its version. Raise it when the measurement gives other numbers: all runs are measured again."""


class Notes(list[str]):
    """Problems, a line each. This is the boundary of a run, search, table or figure: no error ends the report."""

    def attempt(self, read: Callable[[], Found], what: str = "") -> Found | None:
        """The result of `read`; None if it raises any exception, which is noted in one line that begins with `what`.

        Numpy's warnings are not shown: a record may contain any number.
        """
        try:
            with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
                return read()
        except Exception as error:
            kind = "" if isinstance(error, UserError) else f"{type(error).__name__}: "
            line = one_line(f"{what}{kind}{error}")[:500]
            if line not in self:
                self.append(line)
            return None


@dataclass(frozen=True)
class Measured:
    """The measurements of a run: plain data, stored until the run or one of the `VERSIONS` changes.

    Attributes:
        before: evaluation of the recorded predictions.
        after: evaluation of the recalibrated predictions; None without held-out samples.
        pairs: scores of the positions fused from two cameras; None without a record of several views.
        scene: the first test sample in space; None without a Projected Huber density.
        tracks: scores by the frames of a sequence, followed by _2 for two cameras; empty without sequences.
        shifts: scores at home and under each shift; empty without a shift.
        images: a digest of data set and true positions, equal for runs tested on the same images.
    """

    before: Evaluation | None = None
    after: Evaluation | None = None
    temperature: Temperature | None = None
    fusion: FusionScores | None = None
    pairs: Evaluation | None = None
    gallery: Gallery | None = None
    scene: Scene | None = None
    tracks: dict[str, TrackScores] = field(default_factory=dict)
    shifts: dict[str, ShiftScores] = field(default_factory=dict)
    images: str = ""
    notes: list[str] = field(default_factory=list)


def measure(
    folder: RunFolder, config: Mapping[str, str], predictions: Arrays | None, held_out: Arrays | None
) -> Measured:
    """Measure all predictions of a run, its test samples and held-out samples as read; problems are noted."""
    notes = Notes()
    found: dict[str, Any] = {}
    if predictions:
        found["images"] = _images(folder, predictions)
        found["before"] = notes.attempt(lambda: evaluate(_with_volumes(predictions, held_out)))
        if "a" in predictions and held_out:
            found |= notes.attempt(lambda: _recalibrated(predictions, held_out)) or {}
        found["gallery"] = notes.attempt(lambda: make_gallery(predictions, config))
        found["scene"] = notes.attempt(lambda: first_scene(predictions))
        if found["before"] and (left_out := found["before"].left_out):
            notes.append(f"{left_out} test samples are left out: a prediction was not finite")
        found["shifts"] = notes.attempt(lambda: shift_scores(folder.shifts, predictions, held_out)) or {}
    if folder.views.exists() and (views := notes.attempt(lambda: read_views(folder.views))):
        found["pairs"] = notes.attempt(lambda: two_cameras(views))
        found["fusion"] = notes.attempt(lambda: fusion_scores(views)) if views.is_huber else None
    found["tracks"] = notes.attempt(lambda: _tracks(folder)) or {}
    return Measured(**found, notes=notes)


def _with_volumes(predictions: Arrays, held_out: Arrays | None) -> Arrays:
    """The predictions with the volumes of their conformal regions, where the record permits it."""
    with suppress(RunError):  # too few held-out samples, or a record from before the volumes
        return {**predictions, **conformal_log_volumes(predictions, held_out or {})}
    return predictions


def _tracks(folder: RunFolder) -> dict[str, TrackScores]:
    files = sorted(folder.sequences.glob("*.parquet"))
    held_out = [read_sequences(file) for file in files if file.stem.endswith(HELD_OUT)]
    tested = {file.stem: read_sequences(file) for file in files if not file.stem.endswith(HELD_OUT)}
    if not tested:
        return {}
    cameras = max(map(len, tested.values()))
    if not any(len(each) >= cameras for each in held_out):
        several = f" from {cameras} cameras" if cameras > 1 else ""
        raise RunError(f"{folder.sequences}: no held-out sequences{several}; repeat the command of the training")
    chosen = [choose([each[:k] for each in held_out if len(each) >= k]) for k in range(1, cameras + 1)]
    return {
        frames if k == 1 else f"{frames}_{k}": track_scores(each[:k], choice)
        for frames, each in sorted(tested.items(), key=lambda pair: int(pair[0]))
        for k, choice in enumerate(chosen[: len(each)], 1)
    }


def _recalibrated(predictions: Arrays, held_out: Arrays) -> dict[str, Any]:
    temperature = fit_temperature(held_out)
    return {"temperature": temperature, "after": evaluate(recalibrated(predictions, temperature), stratified=False)}


def _images(folder: RunFolder, table: Arrays) -> str:
    """A digest that includes the name of the data set: its variants have equal positions in other images."""
    name = os.fsencode(folder.path.parts[-3])
    positions = b"".join(table[axis].tobytes() for axis in "xyz" if axis in table)
    return hashlib.sha256(name + positions).hexdigest()[:16]


_ADAPTER: TypeAdapter[Measured] = TypeAdapter(Measured)


def kept_or_measured(
    folder: RunFolder, config: Mapping[str, str], measuring: Callable[[], Measured], kept: Path
) -> Measured:
    """The measurements stored in the folder `kept` if the run has not changed; else measures, and stores them."""
    files = [folder.predictions, folder.held_out, folder.views, folder.config_file, images_folder(config)]
    files += [*sorted(folder.shifts.glob("*.parquet")), *sorted(folder.sequences.glob("*.parquet"))]
    return stored(kept / f"{file_stem(*folder.names)}.json", files, _ADAPTER, measuring)


def stored(
    file: Path, sources: Sequence[Path | None], adapter: TypeAdapter[Found], measuring: Callable[[], Found]
) -> Found:
    """What a file holds if its sources and the versions have not changed; else measures, and writes it."""
    key = hashlib.sha256(json.dumps([VERSIONS, *map(_stamp, sources)]).encode()).hexdigest()
    try:
        beginning(file)  # raises an error for a pipe, which would never be read
        content = json.loads(file.read_text())
        if content["key"] == key:
            return adapter.validate_python(content["measured"])
    except (OSError, ValueError, LookupError, TypeError):
        pass  # nothing is stored, or another version stored it
    measured = measuring()
    with suppress(OSError):  # then the next report measures again
        if beginning(file)[:8] in (b"", b'{"key": '):  # otherwise another program's
            write_atomic(file, json.dumps({"key": key, "measured": adapter.dump_python(measured)}))
    return measured


def _stamp(path: Path | None) -> tuple[str, int, int]:
    try:
        stat = path.stat() if path else None
    except (OSError, ValueError):
        stat = None
    return (str(path), stat.st_mtime_ns, stat.st_size) if stat else (str(path), 0, 0)

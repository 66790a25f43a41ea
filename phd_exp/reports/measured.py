"""What is measured of a run's predictions, inside one boundary, and kept on disk until the run changes."""

import hashlib
import json
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from pydantic import TypeAdapter

from phd_exp.distributions.temperature import Temperature
from phd_exp.evaluation.fusion import FusionScores, fusion_scores
from phd_exp.evaluation.parquet import Columns, read_table
from phd_exp.evaluation.predictions import (
    Evaluation,
    evaluate,
    evaluate_points,
    fit_temperature,
    recalibrated,
)
from phd_exp.evaluation.several_views import read_views
from phd_exp.records.errors import UserError, one_line
from phd_exp.records.files import write_atomic
from phd_exp.records.runs import RunFolder
from phd_exp.reports.gallery import Gallery, images_folder, make_gallery
from phd_exp.reports.table import file_stem

Found = TypeVar("Found")


class Notes(list[str]):
    """What is wrong with a run, a line each. This is the boundary of a run: nothing it does ends the report."""

    def attempt(self, read: Callable[[], Found]) -> Found | None:
        """What `read` returns; None where it raises anything, which is then noted in one line."""
        try:
            return read()
        except Exception as error:
            kind = "" if isinstance(error, UserError) else f"{type(error).__name__}: "
            line = one_line(f"{kind}{error}")[:500]
            if line not in self:
                self.append(line)
            return None


@dataclass(frozen=True)
class Measured:
    """What is measured of a run: plain data, kept on disk until the run or this code changes.

    Attributes:
        before: of the predictions as recorded.
        after: of the same predictions recalibrated; None where nothing was held out.
        images: a digest of data set and true positions: runs with the same one were tested on the same images.
    """

    before: Evaluation | None = None
    after: Evaluation | None = None
    temperature: Temperature | None = None
    fusion: FusionScores | None = None
    gallery: Gallery | None = None
    images: str = ""
    notes: list[str] = field(default_factory=list)


def measure(folder: RunFolder, config: Mapping[str, str]) -> Measured:
    """Measure all predictions of a run; what cannot be measured is noted."""
    notes = Notes()
    found: dict[str, Any] = {}
    if folder.predictions.exists() and (table := notes.attempt(lambda: read_table(folder.predictions))):
        found["images"] = _images(folder, table)
        if "a" in table:
            found["before"] = notes.attempt(lambda: evaluate(table))
        else:
            found["before"] = notes.attempt(lambda: evaluate_points(table))
        if "a" in table and folder.held_out.exists():
            found |= notes.attempt(lambda: _recalibrated(folder, table)) or {}
        found["gallery"] = notes.attempt(lambda: make_gallery(table, config))
        if found["before"] and (left_out := found["before"].left_out):
            notes.append(f"{left_out} test samples are left out: a prediction was not finite")
    if folder.views.exists():
        found["fusion"] = notes.attempt(lambda: fusion_scores(read_views(folder.views)))
    return Measured(**found, notes=notes)


def _recalibrated(folder: RunFolder, table: Columns) -> dict[str, Any]:
    temperature = fit_temperature(read_table(folder.held_out))
    return {"temperature": temperature, "after": evaluate(recalibrated(table, temperature))}


def _images(folder: RunFolder, table: Columns) -> str:
    """Of the data set's name too: its variants show the same positions in other images."""
    name = os.fsencode(folder.path.parts[-3])
    positions = b"".join(table[axis].tobytes() for axis in "xyz" if axis in table)
    return hashlib.sha256(name + positions).hexdigest()[:16]


_ADAPTER: TypeAdapter[Measured] = TypeAdapter(Measured)


def kept_or_measured(folder: RunFolder, config: Mapping[str, str], kept: Path | None) -> Measured:
    """What was measured before, if nothing has changed since; else measured now, and kept."""
    if kept is None:
        return measure(folder, config)
    file = kept / f"{file_stem(*folder.path.parts[-4:])}.json"
    key = _key(folder, config)
    try:
        content = json.loads(file.read_text())
        if content["key"] == key:
            return _ADAPTER.validate_python(content["measured"])
    except (OSError, ValueError, LookupError, TypeError):
        pass  # nothing is kept, or another version kept it
    measured = measure(folder, config)
    with suppress(OSError):  # without it the next report measures again
        write_atomic(file, json.dumps({"key": key, "measured": asdict(measured)}))
    return measured


def _key(folder: RunFolder, config: Mapping[str, str]) -> str:
    """A digest that changes whenever a measurement would: the run's tables, its images, this code."""
    files = [folder.predictions, folder.held_out, folder.views, folder.config_file, images_folder(config)]
    return hashlib.sha256(json.dumps([_code(), *map(_stamp, files)]).encode()).hexdigest()


def _stamp(path: Path | None) -> tuple[str, int, int]:
    try:
        stat = path.stat() if path else None
    except (OSError, ValueError):
        stat = None
    return (str(path), stat.st_mtime_ns, stat.st_size) if stat else (str(path), 0, 0)


@cache
def _code() -> str:
    files = sorted(Path(__file__).parents[1].rglob("*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()

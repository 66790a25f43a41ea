"""What the verbs without Hydra share: arguments `key=value`, and the predictions of a run."""

import gc
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from glob import glob, has_magic
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from phd_exp.records.detections import Detection
from phd_exp.records.errors import ConfigError, DatasetError, RunError, complaint, listed, unknown
from phd_exp.records.recordings import Detections

if TYPE_CHECKING:  # imports of seconds, which follow the checks of the arguments
    from phd_exp.evaluation.conformal import Guarantee
    from phd_exp.inference.answers import Sighting
    from phd_exp.inference.detectors import Detector
    from phd_exp.inference.predictor import Predictor

BEYOND = 1.1  # factor beyond the least and the largest focal length of held-out samples; training reaches further


Item = TypeVar("Item")


class Arguments(BaseModel):
    """Arguments of a verb; a key without a default is required. Each has a description, for --help."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    @classmethod
    def parsed(cls, verb: str, words: Sequence[str]) -> Self:
        """The arguments of `key=value` words. Raises ConfigError, in one line, for the first that is invalid."""
        keys = cls.model_fields
        takes = f"{verb} takes {', '.join(f'{key}=' for key in keys)} (see `python -m phd_exp {verb} --help`)"
        values: dict[str, str] = {}
        for word in words:
            key, _, value = word.partition("=")
            if not value:
                raise ConfigError(f"{word}: expected key=value; {takes}")
            if key not in keys:
                raise ConfigError(unknown(key, keys, takes))
            if key in values:
                raise ConfigError(f"{key}: given twice")
            values[key] = value
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            raise ConfigError(complaint(error.errors(include_url=False)[0], missing=takes)) from None


def four_numbers(expected: str) -> BeforeValidator:
    """Reads A,B,C,D, with or without brackets, as four numbers; the error names what was expected."""

    def read(text: Any) -> tuple[float, ...]:
        try:
            a, b, c, d = map(float, str(text).strip("[]()").split(","))
        except ValueError:
            raise ValueError(f"expected {expected}") from None
        return a, b, c, d

    return BeforeValidator(read)


GUARANTEED = "probability of regions that contain the true position, guaranteed by held-out samples"
Coverage = Annotated[Annotated[float, Field(gt=0, lt=1)] | None, Field(description=GUARANTEED)]
EXECUTED = "packages of the user's own parts that the run names, separated by commas; their code is executed"
Trust = Annotated[str | None, Field(description=EXECUTED)]
ENLARGED = "side of the view of each box over that of the box; 1.2 for tight boxes"
Margin = Annotated[Annotated[float, Field(ge=1, le=3)], Field(description=ENLARGED)]


def _paths(text: str) -> list[str]:
    """Paths separated by commas, and those that match patterns, sorted."""
    found = []
    for part in [text] if os.path.exists(text) else text.split(","):
        matching = sorted(glob(part, recursive=True)) if has_magic(part) and not os.path.exists(part) else [part]
        if not matching:
            raise ValueError(f"no path matches {part}; expected a pattern such as images/*.png")
        found += matching
    return found


Paths = Annotated[tuple[Path, ...], BeforeValidator(_paths)]


class RunArguments(Arguments):
    """The run whose network a verb uses."""

    run: Paths
    """the folder of a run, or a file of `pack`; several, separated by commas, or a folder of seeds are an ensemble"""
    recalibrate: bool = False
    """apply the temperatures that fit the run's held-out samples"""
    calibration: str | None = None
    """a record of `calibrate`: recalibrate with its labelled images, which also guarantee a coverage"""
    trust: Trust = None
    views: Literal["1", "8"] = "1"
    """8: an ensemble of the eight symmetric views of each image"""
    margin: Margin = 1.0

    @model_validator(mode="after")
    def one_calibration(self) -> Self:
        """Refuse two sources of temperatures, and a record of another predictor."""
        if self.calibration and (self.recalibrate or (len(self.run), self.views) != (1, "1")):
            raise ValueError(
                "calibration: recalibrates a single run; expected one run=, no recalibrate= and no views=8"
            )
        return self


def trusted(packages: str | None) -> tuple[str, ...]:
    """The packages that trust= names."""
    return tuple(packages.split(",")) if packages else ()


def loaded(arguments: RunArguments, device: str = "auto", coverage: Coverage = None) -> "Predictor":
    """The predictor of a run, ready to guarantee a coverage; a note on standard error names an unfinished run."""
    with _without_collector():
        from phd_exp.inference.loading import load
    trust = trusted(arguments.trust)
    predictor = load(arguments.run, device, trust=trust, views=int(arguments.views), margin=arguments.margin)
    if predictor.state != "finished":
        print(f"note: {arguments.run[0]}: the run is {predictor.state}; its last checkpoint is used", file=sys.stderr)
    guarantees = coverage is not None
    if arguments.calibration:
        return predictor.calibrated(arguments.calibration, guarantees=guarantees)
    if predictor.views > 1 and (arguments.recalibrate or coverage) and not arguments.run[0].is_file():
        _record_held_out_views(predictor, trust)
    return predictor.recalibrated(guarantees=guarantees) if arguments.recalibrate else predictor


@contextmanager
def _without_collector() -> Iterator[None]:
    """Import torch in the body without Python's garbage collector, which takes a tenth of the start.

    The imported objects stay for good, so that they are not searched for garbage later either.
    """
    if "torch" in sys.modules:
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


def _record_held_out_views(predictor: "Predictor", trust: tuple[str, ...]) -> None:
    """Record the eight views of a finished run's held-out samples, unless they are recorded.

    Raises RunError if its data set is not there. Does nothing where `Predictor.held_out` names what is missing.
    """
    from phd_exp.build import build_source
    from phd_exp.config import SourceConfig
    from phd_exp.inference import tables

    folder, data = predictor.folders[0], predictor.config.data
    file = folder.eight_views["held_out"]
    is_possible = len(predictor.folders) == 1 and predictor.is_probabilistic and predictor.state == "finished"
    # a source of one's own is code, which a stored configuration does not run
    if not is_possible or not folder.held_out.exists() or isinstance(data, SourceConfig):
        return
    if not tables.is_recorded(file, tables.of_camera(predictor.config)):
        try:
            tables.record_held_out_views(predictor, build_source(data), trust)
        except DatasetError as error:
            raise RunError(f"{file}: missing, and cannot be recorded without the data set: {error}") from None


def predicted(
    predictor: "Predictor",
    detections: Detections,
    guarantee: "Guarantee | None" = None,
    detector: "Detector | None" = None,
) -> Iterable["Sighting"]:
    """The predictions, with a progress bar for several detections, or images of a detector, on a terminal."""
    from phd_exp.inference.answers import sightings

    each = detections if detector is None else chain.from_iterable(_found(detector, detections))
    seen = _noting_focal_lengths(predictor, sightings(predictor, each, guarantee))
    total = len(detections) if detector is None else None
    return seen if len(detections) == 1 else with_bar(seen, "predicting", total)


def _found(detector: "Detector", images: Detections) -> Iterator[list[Detection]]:
    """The detections in each image. Images without any are noted; DatasetError if no image has one."""
    empty = []
    for image in images:
        if not (found := detector.found_in(image)):
            empty.append(image.where)
        yield found
    if len(empty) == len(images):
        raise DatasetError(f"{listed(empty)}: {detector.name} finds nothing; expected a box in at least one image")
    if empty:
        print(f"note: {detector.name} finds nothing in {len(empty)} image(s): {listed(empty)}", file=sys.stderr)


def with_bar(items: Iterable[Item], words: str, total: int | None) -> Iterable[Item]:
    """The items, with a progress bar on a terminal; `total` is their number, if it is known."""
    if not sys.stderr.isatty():
        return items
    from rich.console import Console
    from rich.progress import track

    return track(items, words, total, console=Console(stderr=True), transient=True)


def _noting_focal_lengths(predictor: "Predictor", seen: Iterable["Sighting"]) -> Iterator["Sighting"]:
    """The predictions; afterwards a note on standard error if the network views some at untrained focal lengths."""
    low, high, remedy = _trained_focal_lengths(predictor)
    first, n = "", 0
    for sighting in seen:
        f = sighting.view.camera.f
        if not 0.999 * low <= f <= 1.001 * high:
            first, n = first or f"{sighting.detection.where}: {f:.4g} px", n + 1
        yield sighting
    if n:
        print(
            f"note: f: {n} view(s) have a focal length that the network was not trained with, first "
            f"{first}; expected {low:.4g} to {high:.4g} px in its images of {predictor.side} px; {remedy}",
            file=sys.stderr,
        )


def _trained_focal_lengths(predictor: "Predictor") -> tuple[float, float, str]:
    """The least and the largest focal length of the training, px of the network's image, and what to do beyond them.

    Of views of boxes, where distance and size of the box decide them, those of the recorded held-out samples.
    """
    from phd_exp.config import RenderedConfig
    from phd_exp.evaluation.parquet import read_table, require_columns

    data, file = predictor.config.data, predictor.folders[0].held_out
    if not (isinstance(data, RenderedConfig) and data.spec.is_box and file.exists()):
        return *predictor.f_range, "give a box= around the object, or train with another data.f_range"
    table = read_table(file)
    require_columns(("f", "S"), table)
    f = table["f"] / table["S"] * predictor.side
    remedy = "expected distances in data.z_range, and boxes as data.box_size describes them"
    return float(f.min()) / BEYOND, float(f.max()) * BEYOND, remedy

"""What the verbs without Hydra share: arguments `key=value`, and the predictions of a run."""

import gc
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from glob import glob, has_magic
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from phd_exp.records.detections import Detection
from phd_exp.records.errors import ConfigError, DatasetError, RunError, complaint, listed, one_line, unknown
from phd_exp.records.packed import or_example
from phd_exp.records.processes import announce
from phd_exp.records.recordings import Detections

if TYPE_CHECKING:  # imports of seconds, which follow the checks of the arguments
    from phd_exp.evaluation.conformal import Guarantee
    from phd_exp.inference.answers import Sighting
    from phd_exp.inference.detectors import Detector
    from phd_exp.inference.predictor import Predictor

SEVERAL = 64  # views, all of them far beyond the training, after which the others are not read

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
ANYWAY = "predict from views with focal lengths more than a fifth beyond those of the training too"
Beyond = Annotated[bool, Field(description=ANYWAY)]


def _paths(text: str) -> list[str]:
    """Paths separated by commas, those that match patterns, sorted, and names of the examples of the package."""
    found = []
    for part in [text] if os.path.exists(text) else text.split(","):
        matching = sorted(glob(part, recursive=True)) if has_magic(part) and not os.path.exists(part) else [part]
        if not matching:
            raise ValueError(f"no path matches {part}; expected a pattern such as images/*.png")
        found += [str(or_example(Path(path))) for path in matching]
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
        announce(f"note: {arguments.run[0]}: the run is {predictor.state}; its last checkpoint is used")
    guarantees = coverage is not None
    if arguments.calibration:
        return predictor.calibrated(arguments.calibration, guarantees=guarantees)
    if predictor.network.views > 1 and (arguments.recalibrate or coverage) and not arguments.run[0].is_file():
        _record_held_out_views(predictor)
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


def _record_held_out_views(predictor: "Predictor") -> None:
    """Record the eight views of a finished run's held-out samples, unless they are recorded.

    Raises RunError if its data set is not there. Does nothing where `Predictor.held_out` names what is missing.
    """
    from phd_exp.build import build_source
    from phd_exp.config import SourceConfig
    from phd_exp.training import tables

    folder, data = predictor.folders[0], predictor.config.data
    file = folder.eight_views["held_out"]
    is_possible = len(predictor.folders) == 1 and predictor.is_probabilistic and predictor.state == "finished"
    # a source of one's own is code, which a stored configuration does not run
    if not is_possible or not folder.held_out.exists() or isinstance(data, SourceConfig):
        return
    if not tables.is_recorded(file, tables.of_camera(predictor.config)):
        try:
            tables.record_held_out_views(folder, predictor.config, build_source(data))
        except DatasetError as error:
            raise RunError(f"{file}: missing, and cannot be recorded without the data set: {error}") from None


def predicted(
    predictor: "Predictor",
    detections: Detections,
    guarantee: "Guarantee | None" = None,
    detector: "Detector | None" = None,
    beyond: bool = False,
    needs_all: bool = False,
) -> Iterable["Sighting"]:
    """The predictions, with a progress bar for several detections, or images of a detector, on a terminal.

    Unless `beyond`, views far beyond the training are left out: DatasetError names them after the others, or at once
    if the caller needs all.
    """
    from phd_exp.inference.answers import sightings

    each = detections if detector is None else chain.from_iterable(_found(detector, detections))
    seen = sightings(predictor, each, guarantee)
    near = seen if beyond else _without_far(predictor, seen, needs_all)
    noted = noting(near, lambda one: (one.detection.where, one.warnings), "predictions")
    total = len(detections) if detector is None else None
    return noted if len(detections) == 1 else with_bar(noted, "predicting", total)


def _without_far(predictor: "Predictor", seen: Iterable["Sighting"], needs_all: bool) -> Iterator["Sighting"]:
    """The predictions from views that are not far beyond the training; afterwards DatasetError names the others."""
    n, refused = 0, list[str]()
    for n, one in enumerate(seen, 1):
        if reason := predictor.ranges.refusal(one.view.camera):
            refused.append(f"{one.detection.where}: {reason}")
            if needs_all or n == len(refused) == SEVERAL:
                break
        else:
            yield one
    if refused:
        several = f"{len(refused)} of {n} views are not predicted, first " if n > 1 else ""
        raise DatasetError(several + refused[0])


def noting(items: Iterable[Item], warned: Callable[[Item], tuple[str, Sequence[str]]], what: str) -> Iterator[Item]:
    """The items; afterwards notes on standard error about the place and the warnings of each, one for each kind."""
    n, found = 0, dict[str, list[str]]()
    for n, item in enumerate(items, 1):  # noqa: B007
        where, warnings = warned(item)
        for kind, _, fault in (warning.partition(": ") for warning in warnings):
            found.setdefault(kind, []).append(f"{where}: {fault}")
        yield item
    for kind, faults in found.items():
        announce(f"note: {kind}: {len(faults)} of {n} {what}, first {faults[0]}")


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
        announce(f"note: {detector.name} finds nothing in {len(empty)} image(s): {listed(empty)}")


def with_bar(items: Iterable[Item], words: str, total: int | None) -> Iterable[Item]:
    """The items, with a progress bar on a terminal; `total` is their number, if it is known."""
    if not sys.stderr.isatty():
        return items
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import track

    return track(items, escape(one_line(words)), total, console=Console(stderr=True), transient=True)

"""`python -m phd_exp predict`: positions of objects in images with their uncertainty, as JSON lines."""

import json
from collections.abc import Iterable
from importlib.util import find_spec
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import model_validator

from phd_exp.cli.arguments import Coverage, Paths, loaded, predicted
from phd_exp.cli.detecting import DetectingArguments
from phd_exp.cli.outputs import message_file, places
from phd_exp.records.detections import Detection, detections_of, named_apart
from phd_exp.records.errors import ConfigError, RunError, UserError, writing
from phd_exp.records.foreign import boxes_in
from phd_exp.records.own_images import detections_in, images_in
from phd_exp.records.processes import announce
from phd_exp.records.recordings import MCAP, Detections, Recording, is_recording
from phd_exp.records.written import Written

if TYPE_CHECKING:  # imports of seconds, which follow the checks of the arguments
    from phd_exp.inference.answers import Sighting
    from phd_exp.inference.predictor import Predictor

LINES = "predictions.jsonl"
LONGEST_STEM = 50  # characters of an image's name in the name of its picture


class PredictArguments(DetectingArguments):
    """The run, the images and their cameras; lengths in pixels of the image file."""

    image: Paths | None = None
    """one image or several, separated by commas or as 'images/*.png', with their camera as f=, or camera="""
    folder: Paths | None = None
    """instead of image=: folders with metadata.jsonl, BOP or COCO, or images and f=; or a ROS 2 recording"""
    out: Path | None = None
    """a folder for predictions.jsonl and pictures; or FILE.mcap for ROS 2 messages, in addition to printed lines"""
    view: Path | None = None
    """a new file *.rrd for the viewer Rerun: images with outlines, and the regions of 50 and 90 % in space"""
    coverage: Coverage = None
    groups: Literal["spread", "truncation", "focal_length"] | None = None
    """with coverage=: guarantee it in each of four groups of predictions by this quantity"""
    curve: bool = False
    """draw the run's calibration curve of depth into the pictures"""

    @model_validator(mode="after")
    def one_source(self) -> "PredictArguments":
        """Require either images with their camera, or a folder with both."""
        if (self.image is None) == (self.folder is None):
            raise ValueError(
                "predict: expected either image=FILE or folder=DIR with f=PIXELS or camera=FILE, or folder=DIR with "
                "metadata.jsonl"
            )
        several = self.folder or len(self.image or ()) > 1
        if self.boxes and not self.function and several:
            raise ValueError("boxes: the boxes of one image=FILE; expected no folder= and no further image")
        is_recorded = any(map(is_recording, self.folder or ()))
        if self.function and not (self.of_camera or is_recorded):
            raise ValueError("boxes: expected f=PIXELS or camera=FILE too")
        if self.object is not None and (self.image or self.of_camera or is_recorded) and not self.boxes:
            raise ValueError("object: selects detections of folder=DIR or boxes=FILE; leave it out for one box")
        if self.groups and not self.coverage:
            raise ValueError("groups: guarantees a coverage; expected coverage=0.9, or another in (0, 1), too")
        if self.curve and (self.out is None or self.out.suffix == MCAP):
            raise ValueError("curve: is drawn into the pictures; expected out=DIR too")
        if self.curve and (len(self.run), self.views) != (1, "1"):
            raise ValueError("curve: is recorded for single runs; expected one run= and no views=8")
        return self


def main(words: list[str]) -> int:
    """Predict each detection; returns the exit status."""
    arguments = PredictArguments.parsed("predict", words)
    out, detections = arguments.out, _detections(arguments)
    inputs = [detections.path] if isinstance(detections, Recording) else [one.file for one in detections]
    if out is not None and out.suffix != MCAP and find_spec("matplotlib") is None:
        raise ConfigError("out: pictures need `pip install 'phd_exp[report]'`; without out= there is JSON alone")
    known = [] if isinstance(detections, Recording) or arguments.function else detections
    names = [_picture(number, len(known), one) for number, one in enumerate(known, start=1)]
    places(arguments, inputs, "predictions", [LINES, *names])
    detector = arguments.detector()  # whose mistakes need no network
    predictor = loaded(arguments, coverage=arguments.coverage)
    if arguments.view is not None or (out is not None and out.suffix == MCAP):
        predictor.require_densities(f"{'view=' if arguments.view else f'out=*{MCAP}'} needs")
    guarantee = predictor.guarantee(arguments.coverage, arguments.groups) if arguments.coverage else None
    curve = _depth_curve(predictor) if arguments.curve else None
    found = iter(predicted(predictor, detections, guarantee, detector, arguments.beyond))
    begun = chain(list(islice(found, 1)), found)  # a refused command leaves the files of an earlier one
    sightings = _viewed(arguments, begun)
    if out is not None and out.suffix != MCAP:
        _write(predictor, sightings, len(detections), out, curve, guarantee)
        return 0
    with message_file(out) as messages:
        if messages is not None:
            from phd_exp.inference.ros import write_predictions

            sightings = write_predictions(messages, sightings)
        for sighting in sightings:
            print(json.dumps(sighting.line, allow_nan=False), flush=True)
    return 0


def _detections(arguments: PredictArguments) -> Detections:
    """The detections; of a detector, the images without boxes."""
    camera, folders = arguments.of_camera, arguments.folder or ()
    if len(folders) > 1 and any(map(is_recording, folders)):
        raise ConfigError("folder: got a recording and more; expected one recording, or several folders")
    if recording := arguments.recording(folders[0] if folders else None):
        return recording
    if folders and not camera:
        found = [one for folder in folders for one in detections_in(folder, object_name=arguments.object)]
        return named_apart(found) if len(folders) > 1 else found
    files = [file for folder in folders for file in images_in(folder)] or arguments.image or ()
    boxes = boxes_in(arguments.boxes, arguments.object) if arguments.boxes and not arguments.function else [{}]
    return detections_of(files, camera, boxes)


def _viewed(arguments: PredictArguments, sightings: Iterable["Sighting"]) -> Iterable["Sighting"]:
    """The sightings, each of which is written to view= first."""
    if arguments.view is None:
        return sightings
    from phd_exp.inference.rerun_view import viewed

    return viewed(arguments.view, sightings)


def _write(
    predictor: "Predictor", sightings: Iterable["Sighting"], n: int, out: Path, curve: Any, guarantee: Any
) -> None:
    """Write each line of `predictions.jsonl` before its picture, whose name begins with the line's number."""
    from phd_exp.inference.pictures import picture

    with (
        writing(out, "out=DIR", UserError),
        Written(out, "predictions") as written,
        open(written.place(LINES), "w", buffering=1) as lines,
    ):
        for number, sighting in enumerate(sightings, start=1):
            name = _picture(number, n, sighting.detection)
            line = sighting.line | {"picture": name}
            lines.write(json.dumps(line, allow_nan=False) + "\n")
            written.write(name, picture(sighting, line, curve, guarantee))
    announce(f"{out / LINES}, and a picture for each line")


def _picture(number: int, n: int, detection: Detection) -> str:
    """The name of the picture of a line."""
    return f"{number:0{len(str(n))}}-{Path(detection.line.file_name).stem[:LONGEST_STEM]}.png"


def _depth_curve(predictor: "Predictor") -> dict[str, Any]:
    """The calibration curve of depth on the run's test samples, recalibrated like the predictions.

    Raises RunError if there is none, as for a baseline.
    """
    import torch

    from phd_exp.evaluation.parquet import read_table
    from phd_exp.evaluation.predictions import recalibrated
    from phd_exp.metrics.calibration import calibration_curve

    file = predictor.folders[0].predictions
    table = read_table(file) if file.exists() else {}
    if predictor.temperature is not None:
        table = recalibrated(table, predictor.temperature)
    try:
        variance, error = (torch.from_numpy(table[f"depth_{name}"]) for name in ("variance", "squared_error"))
        return calibration_curve(variance, error, predictor.config.evaluation.calibration_window).as_data()
    except (KeyError, ValueError):
        raise RunError(
            f"{file}: no calibration curve of depth; expected a finished run of a model with a density"
        ) from None

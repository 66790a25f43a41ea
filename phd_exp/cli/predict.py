"""`python -m phd_exp predict`: positions of objects in images with their uncertainty, as JSON lines."""

import json
import sys
from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import field_validator, model_validator

from phd_exp.cli.arguments import (
    Arguments,
    four_numbers,
    output_folder,
    parsed,
    say_if_unfinished,
    with_progress,
)
from phd_exp.records.detections import Detection, detection_of, detections_in
from phd_exp.records.errors import ConfigError, RunError
from phd_exp.records.files import read_plain, write_atomic
from phd_exp.records.parsing import parse_json
from phd_exp.records.runs import RunFolder

if TYPE_CHECKING:  # seconds of imports, which a mistake need not wait for
    from phd_exp.inference.answers import Sighting
    from phd_exp.inference.predictor import Predictor

OF_A_CAMERA = ("f", "fx", "fy", "cx", "cy", "box")
LONGEST_STEM = 50
"""Characters of an image's name in the name of its picture."""


class PredictArguments(Arguments):
    """The run, the images and their cameras; lengths in pixels of the image file."""

    run: Path
    image: Path | None = None
    folder: Path | None = None
    f: float | None = None
    fx: float | None = None
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None
    box: tuple[float, float, float, float] | None = None
    out: Path | None = None
    recalibrate: bool = False
    calibration: bool = False

    @field_validator("box", mode="before")
    @classmethod
    def box_of_four_numbers(cls, text: Any) -> Any:
        """A box as it is written on a command line."""
        return four_numbers(text, "box=LEFT,TOP,RIGHT,BOTTOM in pixels")

    @model_validator(mode="after")
    def one_source(self) -> "PredictArguments":
        """Require either an image with its camera, or a folder with both."""
        if (self.image is None) == (self.folder is None):
            raise ValueError(
                "predict: expected either image=FILE with f=PIXELS, or folder=DIR with a metadata.jsonl in it"
            )
        given = [key for key in OF_A_CAMERA if getattr(self, key) is not None]
        if self.folder is not None and given:
            raise ValueError(
                f"{given[0]}: belongs to image=FILE; for a folder, write it into each line of metadata.jsonl"
            )
        if self.calibration and self.out is None:
            raise ValueError("calibration: is drawn into the pictures; expected out=DIR too")
        return self

    def detections(self) -> list[Detection]:
        """The detections to predict. Raises DatasetError if they cannot be read."""
        if self.folder is not None:
            return detections_in(self.folder)
        assert self.image is not None
        camera = {key: getattr(self, key) for key in OF_A_CAMERA}
        return [detection_of(self.image, {key: value for key, value in camera.items() if value is not None})]


def main(words: list[str]) -> int:
    """Predict as the words say; returns the exit status."""
    arguments = parsed("predict", PredictArguments, words)
    detections = arguments.detections()
    if arguments.out is not None:
        _require_drawing()
        _require_no_image_lost(detections, arguments.out)
        output_folder(arguments.out)
    _predict(arguments, detections)
    return 0


def _predict(arguments: PredictArguments, detections: list[Detection]) -> None:
    from phd_exp.inference.predictor import load

    predictor = load(arguments.run, recalibrate=arguments.recalibrate)
    say_if_unfinished(arguments.run, predictor.state)
    curve = _depth_curve(arguments.run, predictor) if arguments.calibration else None
    from phd_exp.inference.answers import answer, sightings

    seen = with_progress(sightings(predictor, detections), len(detections), "predicting")
    answers = ((sighting, answer(sighting, predictor.temperature)) for sighting in seen)
    if arguments.out is not None:
        _write(answers, len(detections), arguments.out, predictor.temperature is not None, curve)
        return
    for _, said in answers:
        print(json.dumps(said, allow_nan=False), flush=True)


def _write(
    answers: Iterable[tuple["Sighting", dict[str, Any]]],
    n: int,
    out: Path,
    recalibrated: bool,
    curve: dict[str, Any] | None,
) -> None:
    """Write each line of `predictions.jsonl` before its picture, which is named by the number of the line."""
    from phd_exp.inference.pictures import picture

    file = out / "predictions.jsonl"
    file.unlink(missing_ok=True)
    with open(file, "x", buffering=1) as lines:
        for number, (sighting, said) in enumerate(answers, start=1):
            stem = Path(sighting.detection.line.file_name).stem[:LONGEST_STEM]
            name = f"{number:0{len(str(n))}}-{stem}.png"
            lines.write(json.dumps(said | {"picture": name}, allow_nan=False) + "\n")
            write_atomic(out / name, picture(sighting, recalibrated, curve))
    print(f"{file}, and a picture for each line", file=sys.stderr)


def _depth_curve(run: Path, predictor: "Predictor") -> dict[str, Any]:
    """The calibration curve of depth on the run's test samples, recalibrated like the predictions.

    Raises RunError if there is none, as for a baseline.
    """
    if predictor.temperature is not None:
        from phd_exp.evaluation.predictions import recalibrated_depth_curve

        window = predictor.config.evaluation.calibration_window
        return recalibrated_depth_curve(RunFolder(run), predictor.temperature, window).as_data()
    file = RunFolder(run).curves("final")
    try:
        curve = parse_json(read_plain(file).decode())["depth"]
        if {"predicted", "empirical", "window", "left_out"} <= curve.keys():
            return dict(curve)
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        pass
    raise RunError(
        f"{file}: no calibration curve of depth; expected a finished run of a model with a density"
    )


def _require_no_image_lost(detections: list[Detection], out: Path) -> None:
    if out.resolve() in {detection.file.resolve().parent for detection in detections}:
        raise ConfigError(f"out={out}: holds the images themselves; choose another folder")


def _require_drawing() -> None:
    if find_spec("matplotlib") is None:
        raise ConfigError(
            "out: pictures need `pip install 'phd_exp[report]'`; without out= there is JSON alone"
        )

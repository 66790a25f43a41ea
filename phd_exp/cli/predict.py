"""`python -m phd_exp predict`: where the object in an image is, and how sure a run is of it, as JSON lines."""

import json
import sys
from collections import Counter
from collections.abc import Iterator
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
    from phd_exp.inference.predictor import Predictor
    from phd_exp.inference.sightings import Sighting

OF_A_CAMERA = ("f", "fx", "fy", "cx", "cy", "box")


class PredictArguments(Arguments):
    """What to look at and with which run; lengths in pixels of the image file."""

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
        """Either an image with its camera, or a folder that says both."""
        if (self.image is None) == (self.folder is None):
            raise ValueError(
                "predict: expected either image=FILE with f=PIXELS, or folder=DIR with a metadata.jsonl in it"
            )
        given = [key for key in OF_A_CAMERA if getattr(self, key) is not None]
        if self.folder is not None and given:
            raise ValueError(
                f"{given[0]}: belongs to image=FILE; of a folder each line of metadata.jsonl says it"
            )
        if self.calibration and self.out is None:
            raise ValueError("calibration: is drawn into the pictures; expected out=DIR too")
        return self

    def detections(self) -> list[Detection]:
        """What is to be looked at. Raises DatasetError where it cannot be read."""
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
    lines = _answers(predictor, detections, arguments.out, curve)
    if arguments.out is None:
        for line in lines:
            print(line, flush=True)
    else:
        file = arguments.out / "predictions.jsonl"
        write_atomic(file, "".join(f"{line}\n" for line in lines))
        print(f"{file}, and a picture beside it for each line", file=sys.stderr)


def _depth_curve(run: Path, predictor: "Predictor") -> dict[str, Any]:
    """Of the run's test samples, as it predicted them or recalibrated, whichever is asked for now.

    Raises RunError where there is none, as of a baseline.
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


def _answers(
    predictor: "Predictor", detections: list[Detection], out: Path | None, curve: dict[str, Any] | None
) -> Iterator[str]:
    """The JSON lines; pictures are drawn on the way."""
    from phd_exp.inference.answers import answer
    from phd_exp.inference.sightings import sightings

    names = iter(_picture_names(detections))
    for sighting in with_progress(sightings(predictor, detections), len(detections), "predicting"):
        if out is not None:
            _draw(sighting, out / next(names), curve)
        yield json.dumps(answer(sighting, predictor.temperature), allow_nan=False)


def _draw(sighting: "Sighting", file: Path, curve: dict[str, Any] | None) -> None:
    from phd_exp.inference.pictures import picture

    write_atomic(file, picture(sighting, curve))


def _picture_names(detections: list[Detection]) -> list[str]:
    """`<name of the image>.png`; with its number for a further detection in an image, or in one of the same name."""
    seen: Counter[str] = Counter()
    names = []
    for detection in detections:
        name = "-".join(Path(detection.line.file_name).with_suffix("").parts)
        seen[name] += 1
        names.append(f"{name}.png" if seen[name] == 1 else f"{name}-{seen[name]}.png")
    return names


def _require_no_image_lost(detections: list[Detection], out: Path) -> None:
    images = {detection.file.resolve() for detection in detections}
    for name in _picture_names(detections):
        if (out / name).resolve() in images:
            raise ConfigError(f"out={out}: {out / name} is one of the images; choose another folder")


def _require_drawing() -> None:
    if find_spec("matplotlib") is None:
        raise ConfigError(
            "out: pictures need `pip install 'phd_exp[report]'`; without out= there is JSON alone"
        )

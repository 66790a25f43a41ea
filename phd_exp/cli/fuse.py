"""`python -m phd_exp fuse`: one position of each scene from several cameras, or from one above a known plane."""

import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import field_validator

from phd_exp.cli.arguments import (
    Arguments,
    four_numbers,
    output_folder,
    parsed,
    say_if_unfinished,
    with_progress,
)
from phd_exp.records.detections import Detection, Observed, detections_in, observed
from phd_exp.records.errors import ConfigError, listed
from phd_exp.records.files import write_atomic


class FuseArguments(Arguments):
    """Which scenes and with which run; the plane holds the v with (nx, ny, nz) . v = offset, world, metres."""

    run: Path
    folder: Path
    plane: tuple[float, float, float, float] | None = None
    out: Path | None = None
    recalibrate: bool = False

    @field_validator("plane", mode="before")
    @classmethod
    def plane_of_four_numbers(cls, text: Any) -> Any:
        """Four finite numbers, and a normal that is not zero."""
        plane = four_numbers(text, "plane=NX,NY,NZ,OFFSET: the points v with normal . v = offset, metres")
        if not all(map(math.isfinite, plane)) or not any(plane[:3]):
            raise ValueError("expected finite numbers, and a normal that is not zero")
        return plane


def main(words: list[str]) -> int:
    """Fuse as the words say; returns the exit status, which is not zero where a scene could not be fused."""
    arguments = parsed("fuse", FuseArguments, words)
    detections = detections_in(arguments.folder)
    scenes = observed(detections)
    if arguments.out is not None:
        _require_file(arguments.out, arguments.folder, detections)
    answers = _answers(arguments, scenes)
    _write(answers, arguments.out)
    failed = [str(answer["scene"]) for answer in answers if answer["status"] != "fused"]
    if failed:
        print(
            f"error: {len(failed)} of {len(answers)} scenes have no fused position: "
            f"{listed(failed)}; the line of each says why",
            file=sys.stderr,
        )
    return 1 if failed else 0


def _answers(arguments: FuseArguments, scenes: Sequence[Observed]) -> list[dict[str, Any]]:
    # seconds of imports, which a mistake need not wait for
    import torch

    from phd_exp.fusion import Plane
    from phd_exp.inference.fused import fused_answers
    from phd_exp.inference.predictor import load
    from phd_exp.inference.sightings import sightings

    predictor = load(arguments.run, recalibrate=arguments.recalibrate)
    if not predictor.is_probabilistic:
        raise ConfigError(
            f"{arguments.run}: predicts positions without uncertainty, which cannot be weighed against one another; "
            "fuse needs a run of model=probabilistic"
        )
    say_if_unfinished(arguments.run, predictor.state)
    plane = None
    if arguments.plane is not None:
        *normal, offset = torch.tensor(arguments.plane, dtype=torch.float64)
        plane = Plane(torch.stack(normal), offset)
    detections = [detection for scene in scenes for detection in scene.detections]
    seen = with_progress(sightings(predictor, detections), len(detections), "predicting")
    return fused_answers(scenes, seen, predictor, plane)


def _write(answers: Sequence[dict[str, Any]], out: Path | None) -> None:
    text = "".join(json.dumps(answer, allow_nan=False) + "\n" for answer in answers)
    if out is None:
        print(text, end="", flush=True)
        return
    write_atomic(out, text)
    print(f"{out}: {len(answers)} scenes", file=sys.stderr)


def _require_file(out: Path, folder: Path, detections: Sequence[Detection]) -> None:
    """Raises ConfigError where the file cannot be written, or is one of those that are read."""
    if out.is_dir():
        raise ConfigError(f"out={out}: is a folder; expected a file, such as {out / 'fused.jsonl'}")
    read = {folder / "metadata.jsonl", *(detection.file for detection in detections)}
    if out.resolve() in {file.resolve() for file in read}:
        raise ConfigError(f"out={out}: is one of the files that are read; choose another")
    output_folder(out.parent)

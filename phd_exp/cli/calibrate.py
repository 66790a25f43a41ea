"""`python -m phd_exp calibrate`: fit the uncertainty of a run to labelled images of the user."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from phd_exp.cli.arguments import Arguments, Margin, Trust, trusted
from phd_exp.cli.outputs import require_output
from phd_exp.records.detections import NumberOrName
from phd_exp.records.errors import ConfigError
from phd_exp.records.own_images import detections_in
from phd_exp.records.runs import RunFolder

COVERAGES = (0.5, 0.8, 0.9, 0.95, 0.99)


class CalibrateArguments(Arguments):
    """The run and the labelled images."""

    run: Path
    """the folder of a run"""
    folder: Path
    """images with their true positions: with a metadata.jsonl, or as BOP or COCO"""
    object: NumberOrName | None = None
    """BOP's obj_id or COCO's category; by default all objects"""
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")] = "photographs"
    """the name of the record, which predict calibration=NAME uses"""
    margin: Margin = 1.0
    trust: Trust = None


def main(words: list[str]) -> int:
    """Predict labelled images, record the predictions, and print what follows from them; returns the exit status."""
    arguments = CalibrateArguments.parsed("calibrate", words)
    if arguments.run.is_file():
        raise ConfigError(f"run={arguments.run}: a packed run records nothing; expected the folder of a run")
    detections = detections_in(arguments.folder, object_name=arguments.object)
    file = RunFolder(arguments.run).labelled(arguments.name)
    require_output(file, str(file.relative_to(arguments.run)), arguments, key="name")
    from phd_exp.data.sources import blocks
    from phd_exp.evaluation.conformal import samples_needed
    from phd_exp.inference.labelled import record_labelled
    from phd_exp.inference.loading import load

    predictor = load(arguments.run, trust=trusted(arguments.trust), margin=arguments.margin)
    table, name = record_labelled(predictor, detections, arguments.name), arguments.name
    temperature = predictor.calibrated(name).temperature
    n = len(set(blocks([one.line for one in detections]).get("block", range(len(detections)))))
    assert temperature is not None
    inside = ", ".join(f"{int((table['level'] <= level).sum())} inside {100 * level:.0f} %" for level in (0.5, 0.9))
    error = 100 * (table["depth_error_mm"] / 1000 / table["z"]).mean()
    print(f"{file}: {len(detections)} labelled detections")
    print(f"  as trained: depth error {error:.2f} %, {inside}")
    print(f"  temperatures of a typical prediction: {temperature}")
    enough = [f"{level:g}" for level in COVERAGES if samples_needed(level) <= n // 2]
    needed = f"{2 * samples_needed(0.9)} images, tracks or scenes"
    print(f"  coverage= can guarantee {', '.join(enough) or 'nothing'}; 0.9 needs {needed}")
    margin = f" margin={arguments.margin:g}" if arguments.margin != 1 else ""
    print(f"  use them: python -m phd_exp predict run={arguments.run} calibration={name}{margin} ...")
    return 0

"""The keys of `predict` and `track` that find objects: boxes of a file, a detector in Python, or the run's own."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Self

from pydantic import model_validator

from phd_exp.cli.arguments import CameraArguments
from phd_exp.records.detections import NumberOrName

if TYPE_CHECKING:  # imports of seconds, which follow the checks of the arguments
    from phd_exp.inference.detectors import Detector
    from phd_exp.inference.predictor import Predictor

FUNCTION = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


class DetectingArguments(CameraArguments):
    """A run, the camera of its images, and how objects are found in them."""

    object: NumberOrName | None = None
    """with boxes= or annotations: the class to use, as COCO's category, BOP's obj_id, KITTI's type; by default all"""
    boxes: Path | None = None
    """instead of box=, a file of COCO results (track: image_id counts frames from 0); or MODULE:FUNCTION in Python"""
    detect: bool = False
    """instead of box=, find the object with the network itself; for runs of recipe=strong"""

    @property
    def function(self) -> str | None:
        """The function MODULE:FUNCTION that boxes= names; None for a file."""
        name = str(self.boxes or "")
        return name if FUNCTION.fullmatch(name) and not Path(name).exists() else None

    @property
    def detects(self) -> bool:
        """Whether a function or the network finds the boxes."""
        return self.detect or self.function is not None

    @model_validator(mode="after")
    def one_detector(self) -> Self:
        """Refuse two origins of boxes."""
        if (self.box is not None) + (self.boxes is not None) + self.detect > 1:
            raise ValueError("box, boxes, detect: got more than one of them; expected one")
        if self.detect and self.object is not None:
            raise ValueError("object: detect=true finds one kind of object; leave it out")
        return self

    def of_function(self) -> "Detector | None":
        """The function that boxes= names, if it names one. Raises ConfigError if it cannot be imported."""
        if self.function is None:
            return None
        from phd_exp.inference.detectors import own_function

        return own_function(self.function, self.object)

    def of_network(self, predictor: "Predictor") -> "Detector | None":
        """The network's own, if detect=true. Raises ConfigError if it makes no map of the object."""
        if not self.detect:
            return None
        from phd_exp.inference.own_detector import own_detector

        return own_detector(predictor)

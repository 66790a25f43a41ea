"""What `predict` and `track` share: the camera, and boxes from a file or from a function in Python."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

from pydantic import model_validator

from phd_exp.cli.arguments import Beyond, RunArguments, four_numbers
from phd_exp.records.detections import NumberOrName
from phd_exp.records.errors import ConfigError
from phd_exp.records.recordings import Recording, is_recording

if TYPE_CHECKING:  # imports of seconds, which follow the checks of the arguments
    from phd_exp.inference.detectors import Detector

BOX = four_numbers("box=LEFT,TOP,RIGHT,BOTTOM in pixels")
OF_A_CAMERA = ("f", "fx", "fy", "cx", "cy", "camera", "box")
FUNCTION = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


class DetectingArguments(RunArguments):
    """A run, the camera of its images, and how objects are found in them."""

    f: float | None = None
    """focal length, px"""
    fx: float | None = None
    """horizontal focal length, px"""
    fy: float | None = None
    """vertical focal length, px"""
    cx: float | None = None
    """column of the principal point, px; by default the middle"""
    cy: float | None = None
    """row of the principal point, px; by default the middle"""
    camera: str | None = None
    """instead of f=, a camera file of ROS, OpenCV, Kalibr, COLMAP or another tool, with the lens"""
    box: Annotated[tuple[float, float, float, float], BOX] | None = None
    """LEFT,TOP,RIGHT,BOTTOM of the object, px; by default the whole image"""
    topic: str | None = None
    """of a recording of several cameras: the topic of the images, or IMAGES,CAMERA_INFO"""
    object: NumberOrName | None = None
    """with boxes= or annotations: the class to use, as COCO's category or BOP's obj_id; by default all"""
    boxes: Path | None = None
    """instead of box=, a file of COCO results (track: image_id counts frames from 0); or MODULE:FUNCTION in Python"""
    beyond: Beyond = False

    def recording(self, folder: Path | None) -> Recording | None:
        """The images of a folder= that is a recording of ROS 2; None if it is not."""
        if folder is None or not is_recording(folder):
            if self.topic:
                raise ConfigError("topic: selects images of a recording; expected folder=FILE.mcap")
            return None
        return Recording.of(folder, self.topic, self.of_camera)

    @property
    def of_camera(self) -> dict[str, Any]:
        """The keys of a camera that were given."""
        return {key: getattr(self, key) for key in OF_A_CAMERA if getattr(self, key) is not None}

    @property
    def function(self) -> str | None:
        """The function MODULE:FUNCTION that boxes= names; None for a file."""
        name = str(self.boxes or "")
        return name if FUNCTION.fullmatch(name) and not Path(name).exists() else None

    @model_validator(mode="after")
    def one_detector(self) -> Self:
        """Refuse two origins of boxes."""
        if self.box is not None and self.boxes is not None:
            raise ValueError("box, boxes: got both; expected one of them")
        return self

    def detector(self) -> "Detector | None":
        """The function that boxes= names, if it names one. Raises ConfigError if it cannot be imported."""
        if self.function is None:
            return None
        from phd_exp.inference.detectors import own_function

        return own_function(self.function, self.object)

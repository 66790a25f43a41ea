"""Detectors, which find boxes in images: checked functions of the user."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from pydantic_core import PydanticCustomError

from phd_exp.config.targets import locate
from phd_exp.data.crops import read_image
from phd_exp.optics.virtual import Box
from phd_exp.records.detections import Detection, line_of
from phd_exp.records.errors import ConfigError, DatasetError, gist, in_user_code, one_line, shown
from phd_exp.records.images import pillow_warnings


@dataclass(frozen=True)
class Detector:
    """A function that finds boxes, with its name for messages.

    Args:
        name: the key and its value.
        find: an RGB image -> boxes (left, top, right, bottom, px), scores, the higher the more certain, and classes,
            whole numbers or names; in any order.
        category: the class to keep; None: all.
    """

    name: str
    find: Callable[[UInt8[np.ndarray, "height width 3"]], Any]
    category: int | str | None = None

    def boxes_in(self, image: UInt8[np.ndarray, "height width 3"], where: str) -> list[dict[str, Any]]:
        """The `box`, `score` and `category_id` of each detection, the most certain first.

        Raises DatasetError if the function raises an error, or returns something else than boxes in the image.
        """
        where = f"{where}: {self.name}"
        try:
            with torch.no_grad():
                found = self.find(image.copy())
        except Exception as error:
            raise DatasetError(f"{where} raised {_reason(error)}; correct the function") from None
        rows = []
        for given in _rows(found, where):
            line = line_of({"file_name": "image", "f": 1.0} | given, where)  # of any camera
            if line.score is None:
                raise DatasetError(f"{where}: score: got None; expected a number")
            box = Detection(line, Path(), where).box(image.shape[1], image.shape[0])
            if self.category is None or str(line.category_id) == str(self.category):
                rows.append({"box": box, "score": line.score, "category_id": line.category_id})
        return sorted(rows, key=lambda row: -row["score"])

    def found_in(self, detection: Detection) -> list[Detection]:
        """What it finds in the image of a detection without a box. Raises DatasetError, also for an invalid image."""
        with pillow_warnings():
            image = np.asarray(read_image(detection.file, detection.content))
        rows = self.boxes_in(image, detection.where)
        return [replace(detection, line=detection.line.model_copy(update=row)) for row in rows]


def own_function(name: str, category: int | str | None = None) -> Detector:
    """The detector MODULE:FUNCTION, from an image to boxes, scores and classes. Raises ConfigError without it."""
    try:
        function = locate(name.replace(":", "."), None)
    except PydanticCustomError as error:
        raise ConfigError(f"boxes={name}: {error.message().removeprefix('_target_: ')}") from None
    return Detector(f"boxes={name}", function, category)


def _reason(error: Exception) -> str:
    """The message of an error of the user's function, and where it was raised."""
    return in_user_code(error) or one_line(f"{type(error).__name__}: {gist(error)}")


def _rows(found: Any, where: str) -> list[dict[str, Any]]:
    """The box, score and class of each detection. Raises DatasetError if there are not as many of each."""
    try:
        parts = tuple(found)
        boxes, scores, classes = (np.asarray(part) for part in parts)
        shapes = boxes.shape, scores.shape, classes.shape
    except Exception as error:  # of a foreign class, too
        got = f"{type(found).__name__} ({_reason(error)})"
    else:
        n = boxes.size // 4
        if scores.shape == classes.shape == (n,) and (boxes.shape == (n, 4) or boxes.size == 0):
            columns = {"box": boxes.reshape(n, 4).tolist(), "score": scores.tolist(), "category_id": classes.tolist()}
            return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        got = f"shapes {shown(shapes)}"
    raise DatasetError(
        f"{where}: got {got}; expected boxes, scores and classes of shapes (n, 4), (n,) and (n,), see "
        "docs/guides/predict.md"
    )


def overlap(one: Box, other: Box) -> float:
    """Area of the intersection of two boxes over that of their union.

    Examples:
        >>> overlap((0.0, 0.0, 2.0, 2.0), (1.0, 0.0, 3.0, 2.0)) == 1 / 3
        True
    """
    sizes = [max(0.0, box[2] - box[0]) * max(0.0, box[3] - box[1]) for box in (one, other)]
    width, height = (min(one[axis + 2], other[axis + 2]) - max(one[axis], other[axis]) for axis in (0, 1))
    common = max(0.0, width) * max(0.0, height)
    return common / (sum(sizes) - common)

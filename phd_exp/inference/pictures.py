"""The paper's first figure for one sighting: level curves on the image, and from above."""

import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from PIL import Image

from phd_exp.distributions.level_curves import LevelCurves, Points, level_curves
from phd_exp.inference.answers import Sighting
from phd_exp.optics.virtual import Box, enlarged
from phd_exp.records.errors import one_line
from phd_exp.reports.figures import Mark, draw_birds_eye, draw_curve, encoded, marks_on_image
from phd_exp.reports.gallery import close_up

LARGEST = 1024  # pixels along the longer side of the image in the picture
LONGEST_NAME = 60  # characters of a file name in the title
MARGIN = 0.5  # width of the margin around a box, in sizes of the box
_HALO = [withStroke(linewidth=3, foreground="#0000009c")]  # for any background


def picture(
    sighting: Sighting, line: Mapping[str, Any], calibration: Mapping[str, Any] | None = None, guarantee: Any = None
) -> bytes:
    """A PNG of the image and the bird's-eye view with level curves of 50, 90 and 99 %, or of a baseline's point.

    Small curves have a close-up. The region of a `Guarantee` has a dashed outline. The last panel has the calibration
    curve of depth, if given. The title has the main numbers of `line`, which is the `answer` for the sighting.
    """
    curves = level_curves(sighting.density) if sighting.density else None
    on_image, above = _outlines(sighting, guarantee)
    pixels = sighting.view.camera.real_pixels
    marks = marks_on_image(curves, sighting.mode, sighting.truth_ahead, pixels, on_image, path_effects=_HALO)
    enlarged = _enlarged(marks, sighting.detection.box(*sighting.image.size))
    panels = 1 + (enlarged is not None) + (curves is not None) + (calibration is not None)
    figure = Figure(figsize=(max(6.0, 4.5 * panels), 4.7), layout="constrained")
    figure.suptitle(_title(sighting, line), fontsize=9, parse_math=False)
    axes = iter(figure.subplots(1, panels, squeeze=False).flat)
    _draw_image(
        next(axes), sighting.image, _around(sighting), marks, {"-": sighting.detection.line.box, ":": enlarged}
    )
    if enlarged:
        _draw_image(next(axes), sighting.image, enlarged, marks, {"-": sighting.detection.line.box})
    if curves:
        _draw_above(next(axes), sighting, curves, above, guarantee)
    if calibration:
        draw_curve(next(axes), "depth", calibration)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph", UserWarning)  # letters that the font lacks
        return encoded(figure, "png", dpi=120)


def _title(sighting: Sighting, line: Mapping[str, Any]) -> str:
    """File, focal length and whether it is recalibrated; below them the position and the intervals of depth."""
    name = one_line(sighting.detection.line.file_name)
    name = name if len(name) <= LONGEST_NAME else f"...{name[-LONGEST_NAME:]}"
    fx, fy = np.diagonal(sighting.view.camera.K)[:2]
    f = f"{fx:g}" if fx == fy else f"{fx:g}, {fy:g}"
    recalibrated = ["recalibrated"] if line["uncertainty"].startswith("recalibrated") else []
    known = "mode" if "mode" in line else "position"
    facts = [f"{known} ({_metres(line[known], ', ')}) m"]
    if interval := line.get("depth_interval", {}).get("90"):
        facts.append(f"depth with 90 %: {_metres(interval, ' to ')} m")
    if region := line.get("region"):
        facts.append(f"depths of the guaranteed region: {_metres(region['depth_interval'], ' to ')} m")
    if kinds := ", ".join(one.partition(":")[0] for one in line["warnings"]):
        facts.append(f"warnings: {kinds}")
    return ", ".join([name, f"f = {f} px", *recalibrated]) + "\n" + ", ".join(facts)


def _metres(values: Sequence[float | None], between: str) -> str:
    return between.join("unknown" if value is None else f"{value:.4g}" for value in values)


def _outlines(sighting: Sighting, guarantee: Any) -> tuple[Points | None, Points | None]:
    """The region of a `Guarantee` on the image, in pixels, and from above, in metres."""
    if not guarantee:
        return None, None
    camera = sighting.view.camera
    on_image, above = guarantee.region(sighting.density, camera.f / camera.S)[0].outlines()
    return camera.real_pixels(on_image), above


def _around(sighting: Sighting) -> Box:
    """The part of the image around the box."""
    width, height = sighting.image.size
    left, top, right, bottom = enlarged(sighting.detection.box(width, height), 1 + 2 * MARGIN)
    return max(0, left), max(0, top), min(width, right), min(height, bottom)


def _enlarged(marks: Sequence[Mark], box: Box) -> Box | None:
    """A square around the marks, if they are close together in the box; None for a single point."""
    points = np.concatenate([points for points, _, _ in marks])
    square = close_up(points, max(box[2] - box[0], box[3] - box[1])) if len(points) > 1 else None
    return (square[0], square[1], square[0] + square[2], square[1] + square[2]) if square else None


def _draw_image(axes: Axes, image: Image.Image, part: Box, marks: list[Mark], frames: dict[str, Box | None]) -> None:
    """A part of the image with the marks, and frames by their line style."""
    left, top, right, bottom = part
    ends = (math.floor(left), math.floor(top), math.ceil(right), math.ceil(bottom))
    inside = np.clip(ends, 0, 2 * image.size).tolist()
    if inside[0] < inside[2] and inside[1] < inside[3]:
        cropped = image.crop(inside)
        cropped.thumbnail((LARGEST, LARGEST))
        axes.imshow(np.asarray(cropped), extent=(inside[0], inside[2], inside[3], inside[1]))
    for dashes, frame in frames.items():
        if frame:
            corner, size = frame[:2], (frame[2] - frame[0], frame[3] - frame[1])
            axes.add_patch(Rectangle(corner, *size, fill=False, edgecolor="w", linestyle=dashes, path_effects=_HALO))
    for points, line, style in marks:
        axes.plot(*points.T, line, **style)
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xlabel="column (px)", ylabel="row (px)")
    axes.locator_params(nbins=5)  # more labels would overlap


def _draw_above(axes: Axes, sighting: Sighting, curves: LevelCurves, outline: Points | None, guarantee: Any) -> None:
    if outline is not None:
        axes.plot(*outline.T, "k--", label=f"{100 * guarantee.coverage:g} % guaranteed")
    draw_birds_eye(axes, curves, sighting.truth_ahead)
    if not np.array_equal(sighting.view.camera.R, np.eye(3)):
        axes.set(xlabel="x (m), camera turned to the box", ylabel="z (m), camera turned to the box")

"""The paper's first figure for one sighting: level curves on the image, and from above."""

import math
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.level_curves import LevelCurves, level_curves
from phd_exp.inference.answers import Sighting
from phd_exp.records.errors import one_line
from phd_exp.reports.figures import draw_birds_eye, draw_curve, encoded

LARGEST = 1024  # pixels along the longer side of the image in the picture
LONGEST_NAME = 60  # characters of a file name in the title
MARGIN = 0.5  # width of the margin around a box, in sizes of the box
_AMBER = "#ffb000"


def picture(
    sighting: Sighting,
    recalibrated: bool = False,
    calibration: Mapping[str, Any] | None = None,
    guarantee: Any = None,
) -> bytes:
    """A PNG of the image and the bird's-eye view with level curves of 50, 90 and 99 %, or of a baseline's point.

    The region of a `Guarantee` has a dashed outline. A third panel has the calibration curve of depth, if given.
    The title has the file name, the focal length and whether the prediction is recalibrated.
    """
    curves = level_curves(sighting.prediction) if isinstance(sighting.prediction, ProjectedHuber) else None
    panels = 1 + (curves is not None) + (calibration is not None)
    figure = Figure(figsize=(4.6 if panels == 1 else 4.5 * panels, 4.4), layout="constrained")
    figure.suptitle(_title(sighting, recalibrated), fontsize=9, parse_math=False)
    _draw_image(figure.add_subplot(1, panels, 1), sighting, curves)
    if calibration:
        draw_curve(figure.add_subplot(1, panels, panels), "depth", calibration)
    if curves:
        axes = figure.add_subplot(1, panels, 2)
        if guarantee:
            camera = sighting.view.camera
            on_image, above = guarantee.region(sighting.prediction, camera.f / camera.S)[0].outlines()
            figure.axes[0].plot(*camera.real_pixels(on_image).T, "--", color=_AMBER)
            axes.plot(*above.T, "k--", label=f"{100 * guarantee.coverage:g} % guaranteed")
        draw_birds_eye(axes, curves, _truth(sighting))
        if not np.array_equal(sighting.view.camera.R, np.eye(3)):
            axes.set(xlabel="x (m), camera turned to the box", ylabel="z (m), camera turned to the box")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph", UserWarning)  # letters that the font lacks
        return encoded(figure, "png", dpi=120)


def _title(sighting: Sighting, recalibrated: bool) -> str:
    name = one_line(sighting.detection.line.file_name)
    name = name if len(name) <= LONGEST_NAME else f"...{name[-LONGEST_NAME:]}"
    fx, fy = np.diagonal(sighting.view.camera.K)[:2]
    f = f"{fx:g}" if fx == fy else f"{fx:g}, {fy:g}"
    return ", ".join([name, f"f = {f} px", *(["recalibrated"] if recalibrated else [])])


def _draw_image(axes: Axes, sighting: Sighting, curves: LevelCurves | None) -> None:
    camera, image = sighting.view.camera, sighting.image
    left, top, right, bottom = sighting.detection.box(*image.size)
    across, down = MARGIN * (right - left), MARGIN * (bottom - top)
    region = (
        max(0, math.floor(left - across)),
        max(0, math.floor(top - down)),
        min(image.width, math.ceil(right + across)),
        min(image.height, math.ceil(bottom + down)),
    )
    shown = image.crop(region)
    shown.thumbnail((LARGEST, LARGEST))
    left, top, right, bottom = region
    axes.imshow(np.asarray(shown), extent=(left, right, bottom, top))
    for thickness, points in zip((1.6, 1.1, 0.7), curves.projected if curves else (), strict=False):
        axes.plot(*camera.real_pixels(points).T, color=_AMBER, linewidth=thickness)
    mode = sighting.prediction.mode.numpy()
    axes.plot(*camera.real_pixels(mode[:2] / mode[2]), "x", color=_AMBER, markersize=6)
    truth = _truth(sighting)
    if truth is not None:
        axes.plot(
            *camera.real_pixels(truth[:2] / truth[2]), "o", color="white", markeredgecolor="black", markersize=4
        )
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xlabel="column (px)", ylabel="row (px)")


def _truth(sighting: Sighting) -> Float[np.ndarray, "3"] | None:
    """The true position in the frame of the virtual camera."""
    if sighting.detection.line.z is None:
        return None
    truth = sighting.view.camera.to_virtual(np.array(sighting.detection.position))
    return truth if truth[2] > 0 else None

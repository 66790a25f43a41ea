"""The paper's first figure for one sighting: level curves on the image, and from above."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.level_curves import LevelCurves, level_curves
from phd_exp.inference.sightings import Sighting
from phd_exp.inference.views import View
from phd_exp.reports.figures import draw_birds_eye, draw_curve, encoded

LARGEST = 1024
"""Pixels along the longer side beyond which an image is shrunk for the picture."""
MARGIN = 0.5
"""Of a box's size, shown about it."""
_AMBER = "#ffb000"


def picture(sighting: Sighting, calibration: Mapping[str, Any] | None = None) -> bytes:
    """A PNG: the image with the curves of 50, 90 and 99 %, and the bird's-eye view; of a baseline the point alone.

    With the calibration curve of depth on the run's test samples, that comes third.
    """
    curves = level_curves(sighting.prediction) if isinstance(sighting.prediction, ProjectedHuber) else None
    panels = 1 + (curves is not None) + (calibration is not None)
    figure = Figure(figsize=(4.6 if panels == 1 else 4.5 * panels, 4.4), layout="constrained")
    _draw_image(figure.add_subplot(1, panels, 1), sighting, curves)
    if calibration:
        draw_curve(figure.add_subplot(1, panels, panels), "depth", calibration)
    if curves:
        axes = figure.add_subplot(1, panels, 2)
        draw_birds_eye(axes, curves, _truth(sighting))
        if sighting.view.is_turned:
            axes.set(xlabel="x (m), camera turned to the box", ylabel="z (m), camera turned to the box")
    return encoded(figure, "png", dpi=120)


def _draw_image(axes: Axes, sighting: Sighting, curves: LevelCurves | None) -> None:
    view, image = sighting.view, sighting.image
    width, height = image.size
    shown = image.copy()
    shown.thumbnail((LARGEST, LARGEST))
    axes.imshow(np.asarray(shown), extent=(0, width, height, 0))
    for thickness, points in zip((1.6, 1.1, 0.7), curves.projected if curves else (), strict=False):
        axes.plot(*pixels(view, points).T, color=_AMBER, linewidth=thickness)
    mode = sighting.prediction.mode.numpy()
    axes.plot(*pixels(view, mode[:2] / mode[2]), "x", color=_AMBER, markersize=6)
    truth = _truth(sighting)
    if truth is not None:
        on = pixels(view, truth[:2] / truth[2])
        axes.plot(*on, "o", color="white", markeredgecolor="black", markersize=4)
    left, top, right, bottom = sighting.detection.box(width, height)
    across, down = MARGIN * (right - left), MARGIN * (bottom - top)
    axes.set(
        xlim=(max(0, left - across), min(width, right + across)),
        ylim=(min(height, bottom + down), max(0, top - down)),
        aspect="equal", xlabel="column (px)", ylabel="row (px)",
    )  # fmt: skip


def pixels(view: View, xy_over_z: Float[np.ndarray, "*points 2"]) -> Float[np.ndarray, "*points 2"]:
    """Pixels of the real image in which (x, y)/z of the virtual camera is seen; NaN behind the real camera."""
    rays = np.concatenate([xy_over_z, np.ones_like(xy_over_z[..., :1])], axis=-1)
    seen = view.camera.to_real(rays) @ view.camera.K.T
    return np.where(seen[..., 2:] > 0, seen[..., :2] / seen[..., 2:], np.nan)


def _truth(sighting: Sighting) -> Float[np.ndarray, "3"] | None:
    """The true position in the frame of the virtual camera."""
    if sighting.detection.line.z is None:
        return None
    truth = sighting.view.camera.to_virtual(np.array(sighting.detection.position))
    return truth if truth[2] > 0 else None

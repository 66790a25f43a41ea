"""Calibration curves and level curves, drawn with matplotlib for the report and for single predictions."""

import io
import math
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure  # not pyplot: no global state, no window, no leak over a long sweep
from matplotlib.ticker import NullFormatter

from phd_exp.distributions.level_curves import LevelCurves, Points, on_image
from phd_exp.records.files import write_atomic

AMBER = "#ffb000"
WIDTHS = (1.6, 1.1, 0.7)  # of the lines of 50, 90 and 99 %
Mark = tuple[Points, str, dict[str, Any]]
"""Points of an image, pixels, with the format and the style of their line."""
LABELS = {"depth": ("Depth", "m²"), "projected": ("Projected position", "no unit")}


def draw_calibration(curves: Mapping[str, Mapping[str, Any]], file: Path) -> None:
    """Draw the two calibration curves, empirical against predicted, both axes logarithmic, the identity dashed.

    Source: paper, Figure "correlation between predicted variance and empirical variance".
    """
    figure = Figure(figsize=(8.4, 4.2))
    # fixed margins: `layout="constrained"`, which measures the labels, takes half of the drawing time
    figure.subplots_adjust(left=0.095, right=0.976, bottom=0.143, top=0.905, wspace=0.3125)
    for axes, (name, curve) in zip(figure.subplots(1, 2), curves.items(), strict=True):
        draw_curve(axes, name, curve)
    write_atomic(file, encoded(figure, "png", dpi=120))


def encoded(figure: Figure, kind: str, dpi: int) -> bytes:
    """A figure as the bytes of a `png` or `pdf` file without a date."""
    dateless = {"CreationDate": None} if kind == "pdf" else {}
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=dpi, metadata=dateless)
    return buffer.getvalue()


def draw_curve(axes: Axes, name: str, curve: Mapping[str, Any]) -> None:
    """Draw one calibration curve, of `depth` or of `projected`."""
    draw_identity(axes, name, (*curve["predicted"], *curve["empirical"]), label="calibrated")
    left_out = f", {curve['left_out']} samples left out" if curve["left_out"] else ""
    label = f"window of {curve['window']}{left_out}"
    axes.plot(curve["predicted"], curve["empirical"], color="tab:blue", label=label)
    axes.grid(which="both", alpha=0.25)
    axes.legend(frameon=False)


def draw_identity(axes: Axes, name: str, values: Iterable[float], label: str | None = None) -> None:
    """Prepare logarithmic axes around the values of calibration curves, with the identity dashed."""
    bounds = decades(values) or (0.1, 1.0)
    title, unit = LABELS[name]
    axes.plot(bounds, bounds, "--", color="tab:red", linewidth=1, label=label)
    axes.set(xscale="log", yscale="log", xlim=bounds, ylim=bounds, aspect="equal", title=title)
    axes.set(xlabel=f"predicted variance ({unit})", ylabel=f"mean squared error ({unit})")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_minor_formatter(NullFormatter())  # labels inside a single decade would overlap


def draw_on_image(
    axes: Axes, curves: LevelCurves, image: np.ndarray | None, f: float, S: float, truth: np.ndarray | None
) -> None:
    """Draw the image with the curves of (x, y)/z, the mode as a cross and the projected truth as a dot."""
    if image is not None:
        axes.imshow(image, extent=(0, S, S, 0))
    for points, line, style in marks_on_image(curves, curves.mode, truth, partial(on_image, f=f, S=S)):
        axes.plot(*points.T, line, **style)
    axes.set(xlim=(0, S), ylim=(S, 0), aspect="equal", xlabel="column (px)", ylabel="row (px)")


def marks_on_image(
    curves: LevelCurves | None,
    mode: np.ndarray,
    truth: np.ndarray | None,
    pixels: Callable[[Points], Points],
    outline: Points | None = None,
    **style: Any,
) -> list[Mark]:
    """What is drawn on an image, in this order: curves, a dashed outline, the mode as a cross, the truth as a dot.

    `pixels` places (x, y)/z on the image; the outline is in pixels, mode and truth are in metres.
    """
    amber = {"color": AMBER, "markersize": 6, **style}
    rings = zip(WIDTHS, curves.projected if curves else (), strict=False)
    marks: list[Mark] = [(pixels(points), "-", {"linewidth": width, **amber}) for width, points in rings]
    marks += [] if outline is None else [(outline, "--", amber)]
    marks.append((pixels(mode[None, :2] / mode[2]), "x", amber))
    if truth is not None:
        white = {"color": "white", "markeredgecolor": "black", "markersize": 4}
        marks.append((pixels(truth[None, :2] / truth[2]), "o", white))
    return marks


def marks_from_above(curves: LevelCurves, truth: np.ndarray | None) -> list[Mark]:
    """The same of (x, z), metres: curves, mode and truth."""
    blue = {"color": "#0072b2", "markersize": 6}
    rings = zip(WIDTHS, curves.levels, curves.birds_eye, strict=False)
    marks: list[Mark] = [
        (points, "-", {**blue, "linewidth": width, "label": f"{100 * level:g} %"}) for width, level, points in rings
    ]
    marks.append((curves.mode[None, ::2], "x", {**blue, "label": "mode"}))
    if truth is not None:
        marks.append((truth[None, ::2], "o", {"color": "black", "markersize": 4, "label": "truth"}))
    return marks


def draw_birds_eye(axes: Axes, curves: LevelCurves, truth: np.ndarray | None) -> None:
    """Draw the curves of (x, z), the mode as a cross and the truth as a dot; the axes differ in scale."""
    for points, line, style in marks_from_above(curves, truth):
        axes.plot(*points.T, line, **style)
    axes.set(xlabel="x (m)", ylabel="z (m)")
    axes.locator_params(axis="x", nbins=5)  # more labels would overlap
    axes.grid(alpha=0.25)
    axes.legend(frameon=False, fontsize="small")


def decades(values: Iterable[float]) -> tuple[float, float] | None:
    """The powers of ten around the positive finite values; None if there are none.

    Examples:
        >>> decades([0.02, 3.0])
        (0.01, 10.0)
    """
    positive = [value for value in values if 0 < value < math.inf]
    if not positive:
        return None
    # whole decades: labels between them would overlap
    low, high = math.floor(math.log10(min(positive))), math.ceil(math.log10(max(positive)))
    return 10.0**low, 10.0 ** max(high, low + 1)

"""The best and the worst test images of a run, with level curves on the image and from above, as SVG."""

import base64
import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.ticker import MaxNLocator
from PIL import Image

from phd_exp.distributions.columns import from_columns, parameter_names
from phd_exp.distributions.level_curves import LEVELS, LevelCurves, level_curves, on_image
from phd_exp.distributions.projected_huber import ProjectedHuber
from phd_exp.evaluation.parquet import Arrays, require_columns
from phd_exp.records.errors import UserError
from phd_exp.records.files import require_plain
from phd_exp.records.images import LARGEST_IMAGE, RENDERED, decoding, pillow_warnings
from phd_exp.reports.figures import Mark, marks_from_above, marks_on_image
from phd_exp.reports.quantities import SCORES

EACH = 6
NEEDED = ("file_name", "f", "S", "x", "y", "z", "mode_x", "mode_y", "mode_z")
LARGEST = 448  # pixels; larger test images are shrunk for the page
_CLOSE = 0.25  # curves smaller than this share of the image have a close-up
_SMALLEST = 0.1  # smallest side of a close-up, a share of the image
_LEFT, _TOP, _RIGHT, _BOTTOM = 44.0, 6.0, 194.0, 170.0  # of the bird's-eye view, SVG units; as in panels.html
_FACTS = {
    "level": ("credible level of the truth", "", 2),
    "visibility": ("visibility", "", 2),
    "truncation": ("truncation", "", 2),
    "f": ("focal length", "px", 0),
    "z": ("true depth", "m", 2),
    "mode_z": ("estimated depth", "m", 2),
}


@dataclass(frozen=True)
class Panel:
    """What is drawn on an image, in its pixels, or from above, in SVG units with ticks in metres."""

    paths: list[str]
    mode: tuple[float, float]
    truth: tuple[float, float]
    x_ticks: list[tuple[float, str]]
    z_ticks: list[tuple[float, str]]


@dataclass(frozen=True)
class Picture:
    """One test sample.

    Attributes:
        image: as a `data:` address; None if the image is not available.
        side: of the image, in pixels.
        close_up: left, top and side of an enlarged part; None if the curves fill the image.
        facts: pairs of a name and a value.
    """

    name: str
    alt: str
    image: str | None
    side: float
    panel: Panel
    close_up: tuple[float, float, float] | None
    birds_eye: Panel | None
    facts: list[tuple[str, str]]


@dataclass(frozen=True)
class Gallery:
    """The pictures of a run: best first, and worst first; `ranked_by` names the measure."""

    ranked_by: str
    best: list[Picture]
    worst: list[Picture]
    note: str = ""
    levels: tuple[float, ...] = LEVELS


def images_folder(config: Mapping[str, str]) -> Path | None:
    """The folder of the test images of a rendered data set; None for other images. `config` has dotted keys."""
    root, variant = config.get("data.root"), config.get("data.spec.variant")
    return Path(root) / variant / "test" if root and variant else None


def make_gallery(table: Arrays, config: Mapping[str, str]) -> Gallery:
    """Choose and draw the pictures. Raises RunError if the table lacks a column."""
    require_columns(NEEDED, table)
    if "nll" in table:
        ranked_by, error = "negative log density at the truth", table["nll"]
    else:
        ranked_by = "distance from the truth"
        error = np.linalg.norm([table[f"mode_{axis}"] - table[axis] for axis in "xyz"], axis=0)
    order = np.argsort(error, kind="stable")  # NaN comes last, as the worst
    each = min(EACH, len(order) // 2) or 1
    source = images_folder(config)
    chosen = {name: column[np.concatenate([order[:each], order[::-1][:each]])] for name, column in table.items()}
    rows = [{name: column[place] for name, column in chosen.items()} for place in range(2 * each)]
    pictures = [_picture(row, one, source) for row, one in zip(rows, _distributions(chosen, rows), strict=True)]
    note = _why_no_images(source) if None in [picture.image for picture in pictures] else ""
    return Gallery(ranked_by, pictures[:each], pictures[each:], note)


def _distributions(table: Arrays, rows: Sequence[Mapping[str, Any]]) -> list[ProjectedHuber | None]:
    """The distribution of each row: together if they are of one kind, else one by one."""
    try:
        every = from_columns({name: torch.from_numpy(table[name].astype(float)) for name in parameter_names(table)})
    except (ValueError, KeyError):
        return list(map(distribution_of, rows))
    return [every[place] for place in range(len(rows))]


def _why_no_images(source: Path | None) -> str:
    if source is None:
        return "These images are your own and are not kept with the run: the panels show positions alone."
    return (
        f"{source}: the renders of this run are missing, so the panels show positions alone; `render` with the words "
        "of the training makes them again."
    )


def _picture(row: Mapping[str, Any], distribution: ProjectedHuber | None, source: Path | None) -> Picture:
    truth, mode = (np.array([row[prefix + axis] for axis in "xyz"]) for prefix in ("", "mode_"))
    f, S = float(row["f"]), float(row["S"])
    curves = level_curves(distribution) if distribution else None
    marks = marks_on_image(curves, mode, truth, partial(on_image, f=f, S=S))
    facts = _facts(row)
    image = load_image(source, str(row["file_name"])) if source else None
    return Picture(
        name=str(row["file_name"]),
        alt=f"Test image {row['file_name']}: " + ", ".join(f"{name} {value}" for name, value in facts),
        image=_as_address(image) if image else None,
        side=S,
        panel=_panel(marks, lambda points: points),
        close_up=close_up(np.concatenate([points for points, *_ in marks]), S),
        birds_eye=birds_eye_view(curves, truth) if curves and np.isfinite(truth).all() else None,
        facts=facts,
    )


def curves_of(row: Mapping[str, Any]) -> LevelCurves | None:
    """The level curves of a row; None without a distribution."""
    distribution = distribution_of(row)
    return level_curves(distribution) if distribution else None


def distribution_of(row: Mapping[str, Any]) -> ProjectedHuber | None:
    """The distribution of a row; None for a baseline, or if the parameters are not of one."""
    names = parameter_names(row)
    if any(name not in row for name in names):
        return None
    numbers = {name: torch.tensor(float(row[name]), dtype=torch.float64) for name in names}
    try:
        return from_columns(numbers)
    except ValueError:
        return None


def _facts(row: Mapping[str, Any]) -> list[tuple[str, str]]:
    errors = [name for name in ("nll", "projected_error_mm", "depth_error_mm") if name in row]
    facts = [(SCORES[name].label, f"{SCORES[name].text(row[name])} {SCORES[name].unit}") for name in errors]
    known = [(name, *_FACTS[name]) for name in _FACTS if name in row]
    return facts + [(label, f"{row[name]:.{digits}f} {unit}".strip()) for name, label, unit, digits in known]


def load_image(source: Path, name: str) -> Image.Image | None:
    """A test image, reduced to `LARGEST`; None if it is missing, not an image, or outside its folder."""
    file = source / name
    try:
        if not file.resolve().is_relative_to(source.resolve()):
            return None
        with decoding(file), pillow_warnings():
            require_plain(file, LARGEST_IMAGE)
            with Image.open(file, formats=RENDERED) as image:
                image.thumbnail((LARGEST, LARGEST))
                return image.convert("RGB")
    except (UserError, OSError, ValueError, RuntimeError):  # also a NUL byte, or a link to itself
        return None


def _as_address(image: Image.Image) -> str:
    """The image as a `data:` address, so that a page is one file."""
    buffer = io.BytesIO()
    image.save(buffer, "WEBP", quality=90)
    return f"data:image/webp;base64,{base64.b64encode(buffer.getvalue()).decode()}"


def close_up(points: np.ndarray, S: float) -> tuple[float, float, float] | None:
    """Left, top and side of a square around close points in an image of S pixels; None if they are not close."""
    low, high = points.min(axis=0), points.max(axis=0)
    extent = float((high - low).max())
    if not np.isfinite(extent) or extent > _CLOSE * S:
        return None
    side = max(1.6 * extent, _SMALLEST * S)
    left, top = (low + high) / 2 - side / 2
    return round(float(left), 2), round(float(top), 2), round(side, 2)


def birds_eye_view(curves: LevelCurves, truth: np.ndarray) -> Panel:
    """The view from above: x to the right, z upwards, scaled to the curves and the truth."""
    marks = marks_from_above(curves, truth)
    seen = np.concatenate([points for points, *_ in marks])
    low, high = seen.min(axis=0), seen.max(axis=0)
    margin = np.maximum(0.06 * (high - low), 1e-9)
    low, high = low - margin, high + margin

    def place(points: np.ndarray) -> np.ndarray:
        share = (points - low) / (high - low)
        return np.array([_LEFT, _BOTTOM]) + share * [_RIGHT - _LEFT, _TOP - _BOTTOM]

    x_ticks, z_ticks = (
        [(float(place(np.full(2, value))[axis].round(2)), text) for value, text in _ticks(low[axis], high[axis])]
        for axis in (0, 1)
    )
    return _panel(marks, place, x_ticks, z_ticks)


def _ticks(low: float, high: float) -> list[tuple[float, str]]:
    """Two to five round numbers in an interval, with as many digits as distinguish them."""
    values = MaxNLocator(5, steps=[1, 2, 5, 10]).tick_values(low, high)
    digits = max(0, math.ceil(-math.log10(values[1] - values[0]) - 1e-9))
    return [(value, f"{value:.{digits}f}".replace("-", "−")) for value in values if low <= value <= high]


def _panel(
    marks: Sequence[Mark],
    place: Callable[[np.ndarray], np.ndarray],
    x_ticks: Sequence[tuple[float, str]] = (),
    z_ticks: Sequence[tuple[float, str]] = (),
) -> Panel:
    """The marks of a figure as paths and points of SVG."""
    placed = [(line, place(points)) for points, line, _ in marks]
    mode, truth = (next(_point(points[0]) for line, points in placed if line == kind) for kind in "xo")
    return Panel(
        [_svg_path(points) for line, points in placed if line == "-"], mode, truth, list(x_ticks), list(z_ticks)
    )


def _svg_path(points: np.ndarray) -> str:
    """Points as an SVG path; distant points are clipped, because renderers would lose digits."""
    return "M" + " ".join(f"{x:.2f},{y:.2f}" for x, y in np.clip(points, -1e4, 1e4)) + "Z"


def _point(xy: np.ndarray) -> tuple[float, float]:
    """A point for SVG; NaN becomes a distant point."""
    x, y = np.clip(np.nan_to_num(xy, nan=-1e4), -1e4, 1e4)
    return round(float(x), 2), round(float(y), 2)

"""The best and the worst test images of a run: the level curves on the image and from above, as SVG."""

import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from PIL import Image

from phd_exp.distributions.columns import PARAMETERS, from_columns
from phd_exp.distributions.level_curves import LEVELS, LevelCurves, level_curves, on_image
from phd_exp.records.errors import RunError, UserError
from phd_exp.records.files import require_plain, write_atomic
from phd_exp.records.images import LARGEST_IMAGE, RENDERED, decoding, pillow_warnings
from phd_exp.reports.site.assessment import is_distribution
from phd_exp.reports.site.panels import BirdsEye, birds_eye_view, close_up, point, svg_path
from phd_exp.reports.site.quantities import SCORES

EACH = 6
NEEDED = ("file_name", "f", "S", "x", "y", "z", "mode_x", "mode_y", "mode_z")
LARGEST = 448  # pixels; larger test images are shrunk for the page
_FACTS = {
    "visibility": ("visibility", "", 2),
    "truncation": ("truncation", "", 2),
    "f": ("focal length", "px", 0),
    "z": ("true depth", "m", 2),
    "mode_z": ("estimated depth", "m", 2),
}


@dataclass(frozen=True)
class Picture:
    """One test sample.

    Attributes:
        image: its file's name; None where the image is not at hand.
        side: of the image, pixels, in which `paths`, `mode` and `truth` are given.
        close_up: left, top and side of the part worth enlarging; None where the curves fill the image.
        facts: what is known of it, as pairs of a name and a value.
    """

    name: str
    alt: str
    image: str | None
    side: float
    paths: list[str]
    mode: tuple[float, float]
    truth: tuple[float, float]
    close_up: tuple[float, float, float] | None
    birds_eye: BirdsEye | None
    facts: list[tuple[str, str]]


@dataclass(frozen=True)
class Gallery:
    """The pictures of a run, the best first and the worst first; `ranked_by` names what says which they are."""

    ranked_by: str
    best: list[Picture]
    worst: list[Picture]
    notes: list[str] = field(default_factory=list)
    levels: tuple[float, ...] = LEVELS


def images_folder(config: Mapping[str, str]) -> Path | None:
    """Where the test images of a run on a rendered data set lie; None for images of another kind.

    `config` holds every value by its dotted path.
    """
    root, variant = config.get("data.root"), config.get("data.spec.variant")
    return Path(root) / variant / "test" if root and variant else None


def make_gallery(predictions: pa.Table, config: Mapping[str, str], out: Path) -> Gallery:
    """Choose the pictures, and write their images into `out` (made if missing).

    Raises RunError where the table lacks a column.
    """
    missing = [name for name in NEEDED if name not in predictions.column_names]
    if missing:
        raise RunError(f"no gallery: predictions lack the column {', '.join(missing)}; run the model again")
    columns = {name: predictions[name].to_numpy() for name in predictions.column_names}
    key, ranked_by, error = _ranking(predictions, columns)
    order = np.argsort(error, kind="stable")  # NaN comes last: a prediction that is none is the worst
    each = min(EACH, len(order) // 2) or 1
    source = images_folder(config)
    notes = _why_no_images(source)
    out.mkdir(parents=True, exist_ok=True)

    def pictures(kind: str, rows: np.ndarray) -> list[Picture]:
        return [
            _picture(
                {name: column[row] for name, column in columns.items()},
                key,
                source,
                out / f"{kind}-{rank}.webp",
            )
            for rank, row in enumerate(rows, start=1)
        ]

    return Gallery(ranked_by, pictures("best", order[:each]), pictures("worst", order[::-1][:each]), notes)


def _ranking(predictions: pa.Table, columns: Mapping[str, np.ndarray]) -> tuple[str, str, np.ndarray]:
    if is_distribution(predictions):
        return "nll", "negative log density at the truth", columns["nll"]
    off = np.stack([columns[f"mode_{axis}"] - columns[axis] for axis in "xyz"])
    return "", "distance from the truth", np.linalg.norm(off, axis=0)


def _why_no_images(source: Path | None) -> list[str]:
    if source is None:
        return [
            "These images are your own and are not kept with the run: the panels show where things lie in them."
        ]
    if not source.is_dir():
        return [f"{source}: the images are no longer there; the panels show where things lie in them."]
    return []


def _picture(row: Mapping[str, Any], key: str, source: Path | None, file: Path) -> Picture:
    truth = np.array([row[axis] for axis in "xyz"], dtype=float)
    mode = np.array([row[f"mode_{axis}"] for axis in "xyz"], dtype=float)
    f, S = float(row["f"]), float(row["S"])
    curves = curves_of(row)
    outlines = [on_image(points, f, S) for points in curves.projected] if curves else []
    facts = _facts(row, key)
    image = _copy_image(source, str(row["file_name"]), file)
    on = {"truth": on_image(truth[:2] / truth[2], f, S), "mode": on_image(mode[:2] / mode[2], f, S)}
    return Picture(
        name=str(row["file_name"]),
        alt=f"Test image {row['file_name']}: " + ", ".join(f"{name} {value}" for name, value in facts),
        image=file.name if image else None,
        side=S,
        paths=[svg_path(points) for points in outlines],
        mode=point(on["mode"]),
        truth=point(on["truth"]),
        close_up=close_up(np.concatenate([*outlines, on["truth"][None], on["mode"][None]]), S),
        birds_eye=birds_eye_view(curves, truth) if curves and np.isfinite(truth).all() else None,
        facts=facts,
    )


def curves_of(row: Mapping[str, Any]) -> LevelCurves | None:
    """The level curves of a row; None for a baseline, and for numbers that are no distribution."""
    if any(name not in row for name in PARAMETERS):
        return None
    numbers = {name: torch.tensor(float(row[name]), dtype=torch.float64) for name in PARAMETERS}
    try:
        return level_curves(from_columns(numbers))
    except ValueError:
        return None


def _facts(row: Mapping[str, Any], key: str) -> list[tuple[str, str]]:
    errors = [name for name in (key, "projected_error_mm", "depth_error_mm") if name in row]
    facts = [(SCORES[name].label, f"{SCORES[name].text(row[name])} {SCORES[name].unit}") for name in errors]
    if "level" in row:
        facts.append(("credible level of the truth", f"{row['level']:.2f}"))
    known = [(name, *_FACTS[name]) for name in _FACTS if name in row]
    return facts + [(label, f"{row[name]:.{digits}f} {unit}".strip()) for name, label, unit, digits in known]


def load_image(source: Path, name: str) -> Image.Image | None:
    """A test image, shrunk where it is large; None where it is not there, no image, or outside its folder."""
    file = source / name
    try:
        if not file.resolve().is_relative_to(source.resolve()):
            return None
        with decoding(file), pillow_warnings():
            require_plain(file, LARGEST_IMAGE)
            with Image.open(file, formats=RENDERED) as image:
                image.thumbnail((LARGEST, LARGEST))
                return image.convert("RGB")
    except (
        UserError,
        OSError,
        ValueError,
        RuntimeError,
    ):  # also a name with a NUL byte, a link that leads to itself
        return None


def _copy_image(source: Path | None, name: str, file: Path) -> bool:
    """Write a copy fit for a page; False where there is no image."""
    image = load_image(source, name) if source else None
    if image is None:
        return False
    buffer = io.BytesIO()
    image.save(buffer, "WEBP", quality=90)
    write_atomic(file, buffer.getvalue())
    return True

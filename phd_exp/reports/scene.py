"""The prediction for one test image in space: the camera, the true position, and regions as surfaces."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from phd_exp.distributions.surfaces import level_surface
from phd_exp.evaluation.parquet import Arrays, require_columns
from phd_exp.reports.charts import Trace
from phd_exp.reports.gallery import NEEDED, distribution_of

LEVELS = (0.5, 0.9)
DEPTHS, ANGLES = 11, 20  # of a surface; each has its place in the page
DIGITS = 5
OPACITY = {0.5: 0.45, 0.9: 0.2}
Positions = list[list[float]]
"""Rows of x, y and z, metres in the frame of the camera."""
Row = Sequence[float | None]
GAP: Row = (None, None, None)


@dataclass(frozen=True)
class Scene:
    """A test sample.

    Attributes:
        corners: those of the image, once around, at the depth of the mode.
        regions: vertices and triangles for each of `levels`.
    """

    name: str
    corners: Positions
    mode: list[float]
    truth: list[float]
    regions: list[tuple[Positions, list[list[int]]]]
    levels: tuple[float, ...] = LEVELS


def first_scene(table: Arrays) -> Scene | None:
    """The scene of the first row, which is not chosen by its error; None without a Projected Huber density.

    Raises RunError if the table lacks a column.
    """
    require_columns(NEEDED, table)
    row = {name: column[0] for name, column in table.items()}
    truth = np.array([row[axis] for axis in "xyz"], float)
    if (distribution := distribution_of(row)) is None or not np.isfinite(truth).all():
        return None
    mode = distribution.mode.numpy()
    edge = float(row["S"]) / 2 / float(row["f"])
    corners = mode[2] * np.array([[-edge, -edge, 1], [edge, -edge, 1], [edge, edge, 1], [-edge, edge, 1]])
    surfaces = [level_surface(distribution, level, DEPTHS, ANGLES) for level in LEVELS]
    regions = [(_rounded(one.vertices), one.triangles.tolist()) for one in surfaces]
    return Scene(str(row["file_name"]), _rounded(corners), _rounded(mode), _rounded(truth), regions)


def _rounded(values: np.ndarray) -> Any:
    return np.vectorize(lambda value: float(f"{value:.{DIGITS}g}"))(values).tolist()


def scene_traces(scene: Scene) -> list[Trace]:
    """Plotly's traces of all parts; `meta.close` is true of those in the close-up."""
    a, b, c, d = scene.corners
    camera: Row = [0.0, 0.0, 0.0]
    edges = [camera, a, b, camera, GAP, camera, c, d, camera, GAP, b, c, GAP, d, a]
    return [
        _trace("camera and the edges of its image", edges, mode="lines", line={"color": "var(--quiet)", "width": 3}),
        *(_surface(*one) for one in zip(scene.levels, scene.regions, strict=True)),
        _point("true position", scene.truth, "circle"),
        _point("mode", scene.mode, "diamond-open"),
    ]


def _trace(name: str, points: Sequence[Row], close: bool = False, **more: Any) -> Trace:
    axes = dict(zip("xyz", zip(*points, strict=True), strict=True))
    return {"type": "scatter3d", "name": name, "meta": {"close": close}, **axes, **more}


def _point(name: str, at: Row, symbol: str) -> Trace:
    marker = {"color": "var(--ink)", "size": 4, "symbol": symbol}
    return _trace(name, [at], close=True, mode="markers", marker=marker)


def _surface(level: float, region: tuple[Positions, list[list[int]]]) -> Trace:
    vertices, triangles = region
    corners = dict(zip("ijk", zip(*triangles, strict=True), strict=True))
    look = {"type": "mesh3d", "color": "var(--series-1)", "opacity": OPACITY[level]}
    return _trace(f"{100 * level:g} % region", vertices, close=True, **look, **corners)

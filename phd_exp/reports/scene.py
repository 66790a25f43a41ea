"""The prediction for one test image in space: the camera, the true position, and regions as surfaces."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from phd_exp.distributions.surfaces import level_surface
from phd_exp.evaluation.parquet import Columns, require_columns
from phd_exp.reports.gallery import NEEDED, distribution_of

LEVELS = (0.5, 0.9)
DEPTHS, ANGLES = 11, 20  # of a surface; each has its place in the page
DIGITS = 5
Positions = list[list[float]]
"""Rows of x, y and z, metres in the frame of the camera."""


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


def first_scene(table: Columns) -> Scene | None:
    """The scene of the first row, which is not chosen by its error; None without a Projected Huber density.

    Raises RunError if the table lacks a column.
    """
    require_columns(NEEDED, table)
    return _scene({name: column[0] for name, column in table.items()})


def _scene(row: Mapping[str, Any]) -> Scene | None:
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

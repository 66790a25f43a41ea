"""What the gallery draws, in the coordinates of its SVG."""

from dataclasses import dataclass

import numpy as np
from matplotlib.ticker import MaxNLocator

from phd_exp.distributions.level_curves import LevelCurves

_CLOSE = 0.25  # a share of the image below which curves deserve a close-up
_SMALLEST = 0.1  # the same for the side of a close-up
_PANEL, _LEFT, _BOTTOM, _EDGE = 200.0, 44.0, 30.0, 6.0  # of the bird's-eye view, in its own units


@dataclass(frozen=True)
class BirdsEye:
    """The curves of (x, z) in a square of `_PANEL` units, with ticks in metres."""

    paths: list[str]
    mode: tuple[float, float]
    truth: tuple[float, float]
    x_ticks: list[tuple[float, str]]
    z_ticks: list[tuple[float, str]]
    size: float = _PANEL
    left: float = _LEFT
    bottom: float = _PANEL - _BOTTOM
    edge: float = _EDGE


def close_up(points: np.ndarray, S: float) -> tuple[float, float, float] | None:
    """Left, top and side of a square around points that lie close together in an image of S pixels; else None."""
    low, high = points.min(axis=0), points.max(axis=0)
    extent = float((high - low).max())
    if not np.isfinite(extent) or extent > _CLOSE * S:
        return None
    side = max(1.6 * extent, _SMALLEST * S)
    left, top = (low + high) / 2 - side / 2
    return _round(left), _round(top), _round(side)


def birds_eye_view(curves: LevelCurves, truth: np.ndarray) -> BirdsEye:
    """The view from above: x to the right, z upwards, scaled so that the curves and the truth are seen."""
    seen = np.concatenate([*curves.birds_eye, curves.mode[None, ::2], truth[None, ::2]])
    low, high = seen.min(axis=0), seen.max(axis=0)
    margin = np.maximum(0.06 * (high - low), 1e-9)
    low, high = low - margin, high + margin
    width, height = _PANEL - _LEFT - _EDGE, _PANEL - _BOTTOM - _EDGE

    def place(points: np.ndarray) -> np.ndarray:
        share = (points - low) / (high - low)
        return np.stack([_LEFT + width * share[..., 0], _PANEL - _BOTTOM - height * share[..., 1]], axis=-1)

    return BirdsEye(
        paths=[svg_path(place(points)) for points in curves.birds_eye],
        mode=point(place(curves.mode[::2])),
        truth=point(place(truth[::2])),
        x_ticks=[(_round(place(np.array([x, low[1]]))[0]), text) for x, text in _ticks(low[0], high[0])],
        z_ticks=[(_round(place(np.array([low[0], z]))[1]), text) for z, text in _ticks(low[1], high[1])],
    )


def _ticks(low: float, high: float) -> list[tuple[float, str]]:
    """A few round numbers between two, with as many digits as tell them apart."""
    values = MaxNLocator(3, steps=[1, 2, 5, 10]).tick_values(low, high)
    digits = max(0, int(np.ceil(-np.log10(values[1] - values[0]) - 1e-9)))
    return [(float(v), f"{v:.{digits}f}".replace("-", "−")) for v in values if low <= v <= high]


def _round(value: float) -> float:
    return round(float(value), 2)


def svg_path(points: np.ndarray) -> str:
    """Points as an SVG path; what lies far outside a picture is brought nearer, or renderers would lose digits."""
    return "M" + " ".join(f"{x:.2f},{y:.2f}" for x, y in np.clip(points, -1e4, 1e4)) + "Z"


def point(xy: np.ndarray) -> tuple[float, float]:
    """A place as SVG takes it; one that is no number lies far outside."""
    x, y = np.clip(np.nan_to_num(xy, nan=-1e4), -1e4, 1e4)
    return _round(x), _round(y)

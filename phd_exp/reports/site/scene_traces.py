"""The traces of plotly for a prediction in space; `meta.close` is true of those in the close-up."""

from collections.abc import Sequence
from typing import Any

from phd_exp.reports.scene import Positions, Scene
from phd_exp.reports.site.charts import Trace

OPACITY = {0.5: 0.45, 0.9: 0.2}
Row = Sequence[float | None]
GAP: Row = (None, None, None)


def scene_traces(scene: Scene) -> list[Trace]:
    """The camera with the edges of its image, the regions, the true position and the mode."""
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

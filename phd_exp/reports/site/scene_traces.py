"""The traces of plotly for a prediction in space; `meta.close` is true of those in the close-up."""

from collections.abc import Sequence
from typing import Any

from phd_exp.reports.scene import Positions, Scene
from phd_exp.reports.site.charts import Trace

OPACITY = {0.5: 0.6, 0.9: 0.2}
COLOUR = {0.5: 1, 0.9: 2}


def scene_traces(scene: Scene) -> list[Trace]:
    """The camera with the edges of its image, the true position, the mode, and the regions."""
    a, b, c, d = scene.corners
    camera, gap = [0.0, 0.0, 0.0], [None, None, None]
    edges = [camera, a, b, camera, gap, camera, c, d, camera, gap, b, c, gap, d, a]
    frame = _lines("camera and the edges of its image", edges)
    surfaces = [_surface(*one) for one in zip(scene.levels, scene.regions, strict=True)]
    truth, mode = _point("true position", scene.truth, "--ink", "circle"), _point("mode", scene.mode, "--bad", "x")
    return [frame, *surfaces, truth, mode]


def _axes(points: Sequence[Sequence[float | None]]) -> dict[str, Any]:
    return dict(zip("xyz", zip(*points, strict=True), strict=True))


def _lines(name: str, points: Sequence[Sequence[float | None]]) -> Trace:
    line = {"color": "var(--quiet)", "width": 3}
    return {"type": "scatter3d", "mode": "lines", "name": name, "line": line, "meta": {"close": False}} | _axes(
        points
    )


def _point(name: str, at: list[float], colour: str, symbol: str) -> Trace:
    marker = {"color": f"var({colour})", "size": 4, "symbol": symbol}
    return {"type": "scatter3d", "mode": "markers", "name": name, "marker": marker, "meta": {"close": True}} | _axes(
        [at]
    )


def _surface(level: float, region: tuple[Positions, list[list[int]]]) -> Trace:
    vertices, triangles = region
    return {
        "type": "mesh3d",
        "name": f"{100 * level:g} % region",
        "color": f"var(--series-{COLOUR[level]})",
        "opacity": OPACITY[level],
        "meta": {"close": True},
        **_axes(vertices),
        **dict(zip("ijk", zip(*triangles, strict=True), strict=True)),
    }

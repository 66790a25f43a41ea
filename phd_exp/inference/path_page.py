"""An offline page with the paths of a `track.jsonl`: in three dimensions, and depth over time."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from phd_exp.inference.path_video import COLOURS
from phd_exp.records.files import LONGEST_LINE, write_atomic
from phd_exp.records.parsing import parse_json

MOST = 4000  # frames in the page; of longer files every second one, or fourth, and so on


def write_page(lines: Path, page: Path) -> None:
    """Write the page of a file of lines, which it reads one at a time; nothing if no frame has a position.

    Raises OSError if a file cannot be read or written.
    """
    frames = _thinned(lines)
    paths: dict[tuple[str, int], list[dict[str, Any]]] = {}
    for frame in frames:
        paths.setdefault((frame["name"], frame["track"]), []).append(frame)
    if not paths:
        return
    figure = make_subplots(
        rows=2,
        cols=1,
        specs=[[{"type": "scene"}], [{"type": "xy"}]],
        row_heights=[0.7, 0.3],
        vertical_spacing=0.05,
        subplot_titles=["Path", "Depth, with its 90 % interval"],
    )
    for (name, track), path in paths.items():
        label = f"{name}, {track}" if len(paths) > 1 else name
        figure.add_trace(_in_space(label, path), 1, 1)
        for trace in _over_time(label, path):
            figure.add_trace(trace, 2, 1)
    figure.update_scenes(
        aspectmode="data",
        xaxis_title="x (m)",
        yaxis_title="y (m)",
        zaxis_title="z (m)",
        camera={"up": {"x": 0, "y": -1, "z": 0}, "eye": {"x": 0.6, "y": -0.9, "z": -1.6}},
    )
    figure.update_xaxes(title="time (s)")
    figure.update_yaxes(title="depth (m)")
    figure.update_layout(height=1000, template="plotly_white", title="Tracked, bridged and lost frames")
    write_atomic(page, figure.to_html(include_plotlyjs=True, full_html=True))


def _thinned(lines: Path) -> list[dict[str, Any]]:
    """The frames with a position, at most `MOST`, evenly."""
    kept: list[dict[str, Any]] = []
    every = 1
    with open(lines) as stream:
        number = 0
        while text := stream.readline(LONGEST_LINE):
            frame = parse_json(text)
            if "mean" not in frame:
                continue
            if number % every == 0:
                kept.append({key: frame[key] for key in ("name", "track", "time", "state", "mean", "depth_interval")})
            number += 1
            if len(kept) > MOST:
                kept, every = kept[::2], 2 * every
    return kept


def _in_space(label: str, path: Sequence[dict[str, Any]]) -> go.Scatter3d:
    x, y, z = zip(*(frame["mean"] for frame in path), strict=True)
    colours = [COLOURS[frame["state"]] for frame in path]
    texts = [f"{frame['time']:.3f} s, {frame['state']}" for frame in path]
    return go.Scatter3d(
        x=x,
        y=y,
        z=z,
        name=label,
        text=texts,
        mode="lines+markers",
        line={"color": "#648fff", "width": 3},
        marker={"color": colours, "size": 3},
    )


def _over_time(label: str, path: Sequence[dict[str, Any]]) -> list[go.Scatter]:
    times = [frame["time"] for frame in path]
    low, high = zip(*(frame["depth_interval"]["90"] for frame in path), strict=True)
    middle = [(a + b) / 2 for a, b in zip(low, high, strict=True)]
    band = go.Scatter(
        x=[*times, *reversed(times)],
        y=[*high, *reversed(low)],
        fill="toself",
        fillcolor="rgba(100, 143, 255, 0.25)",
        line={"width": 0},
        hoverinfo="skip",
        showlegend=False,
    )
    return [band, go.Scatter(x=times, y=middle, name=label, line={"color": "#648fff"}, showlegend=False)]

"""Charts as plain plotly figures: data and layout, in JSON.

Colours are those of the style sheet (`var(--series-1)`): they change with the theme of a page. The `meta` of a trace
is for the script: its `role`, and `low` and `high` of an interval, drawn as a band or as bars.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from phd_exp.evaluation.predictions import Curve

Trace = dict[str, Any]
Numbers = Sequence[float | None]

DASHES = ("solid", "dash", "dot", "dashdot")


@dataclass(frozen=True)
class Chart:
    """One chart; `label` describes it to a screen reader, with the main numbers."""

    title: str
    label: str
    data: list[Trace]
    layout: dict[str, Any]


def chart(title: str, traces: list[Trace], x: Trace, y: Trace) -> Chart:
    """A chart of lines, whose label has the first and the last point of each."""
    label = f"{title}: {y['title']['text']} against {x['title']['text']}. {'; '.join(map(_course, traces))}."
    return Chart(title, label, traces, {"xaxis": x, "yaxis": y})


def _course(trace: Trace) -> str:
    name = trace.get("text", trace["name"])
    known = [(x, y) for x, y in zip(trace["x"], trace["y"], strict=True) if None not in (x, y)]
    if not known:
        return f"{name}: no values"
    (start, first), (end, last) = known[0], known[-1]
    return f"{name} from {first:.3g} at {start:.3g} to {last:.3g} at {end:.3g}"


def axis(title: str, log: bool = False, **more: Any) -> dict[str, Any]:
    """An axis of a layout, linear or logarithmic; `more` are further properties in plotly."""
    return {"title": {"text": title}, "type": "log" if log else "linear", **more}


def line(name: str, x: Numbers, y: Numbers, colour: int, *, dash: str = "solid", **meta: Any) -> Trace:
    """A line; `low` and `high` in `meta` make it a line with a band."""
    points = sum(value is not None for value in y)
    return {
        "type": "scatter",
        "mode": "lines" if points > 1 else "markers",
        "connectgaps": True,  # not every epoch is evaluated
        "name": name,
        "x": _rounded(x),
        "y": _rounded(y),
        "line": {"color": f"var(--series-{colour})", "dash": dash, "width": 2},
        "meta": {"role": "line"}
        | {key: value if isinstance(value, str) else _rounded(value) for key, value in meta.items()},
    }


def curve_line(name: str, curve: Curve, colour: int, dash: str, role: str) -> Trace:
    """A curve with its band."""
    return line(name, curve.x, curve.y, colour, dash=dash, role=role, low=curve.low, high=curve.high)


def bars(name: str, x: Numbers, y: Sequence[str], colour: int, low: Numbers, high: Numbers) -> Trace:
    """Points with intervals, one per category of the vertical axis."""
    return {
        "type": "scatter",
        "mode": "markers",
        "name": name,
        "x": _rounded(x),
        "y": list(y),
        "marker": {"color": f"var(--series-{colour})", "size": 8},
        "meta": {"role": "points", "low": _rounded(low), "high": _rounded(high)},
    }


def bar_chart(title: str, trace: Trace, x: Trace, y: str) -> Chart:
    """A chart of points with intervals, with a category for each line."""
    values = (f"{name}: {value:.3g}" for name, value in zip(trace["y"], trace["x"], strict=True) if value is not None)
    vertical = axis(y) | {"type": "category", "autorange": "reversed"}
    return Chart(title, f"{title}: {'; '.join(values)}.", [trace], {"xaxis": x, "yaxis": vertical})


def identity(low: float, high: float, name: str) -> Trace:
    """The diagonal, on which calibrated values lie."""
    trace = line(name, (low, high), (low, high), 0, dash="dash", role="identity")
    trace["line"]["width"] = 1.5
    return trace


def square(layout: dict[str, Any], low: float, high: float) -> dict[str, Any]:
    """The layout with both axes from low to high."""
    log = layout["xaxis"]["type"] == "log"
    ends = [math.log10(low), math.log10(high)] if log else [low, high]
    return {name: given | {"range": ends} for name, given in layout.items()}


def _rounded(values: Numbers) -> list[float | None]:
    """Rounded to five digits, with None for NaN and infinity, which JSON does not have."""
    return [None if v is None or not math.isfinite(v) else float(f"{v:.5g}") for v in values]

"""Pictures drawn from records."""

import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure  # not pyplot: no global state, no window, no leak over a long sweep

from phd_exp.records.files import write_atomic

LABELS = {
    "depth": ("Depth", "m²"),
    "projected": ("Projected position", "no unit"),
}
_CELL, _LEFT, _RIGHT, _BOTTOM, _TOP = 4.2, 0.8, 0.2, 0.6, 0.4
"""Side of the square in which one curve is drawn, and its margins, inches."""


def draw_calibration(curves: Mapping[str, Mapping[str, Any]], file: Path) -> None:
    """Draw calibration curves, empirical against predicted, both axes logarithmic, the identity dashed.

    Source: paper, Figure "correlation between predicted variance and empirical variance".
    """
    figure = Figure(figsize=(_CELL * len(curves), _CELL))
    _leave_margins(figure, len(curves))
    for place, (name, curve) in enumerate(curves.items()):
        draw_curve(figure.add_subplot(1, len(curves), place + 1), name, curve)
    write_atomic(file, encoded(figure, "png", dpi=120))


def _leave_margins(figure: Figure, columns: int) -> None:
    """The same around every curve: to find what its labels need (`layout="constrained"`) is half of the drawing."""
    figure.subplots_adjust(
        left=_LEFT / (_CELL * columns),
        right=1 - _RIGHT / (_CELL * columns),
        bottom=_BOTTOM / _CELL,
        top=1 - _TOP / _CELL,
        wspace=(_LEFT + _RIGHT) / (_CELL - _LEFT - _RIGHT),
    )


def write_figure(figure: Figure, stem: Path) -> list[Path]:
    """Write `<stem>.png` and `<stem>.pdf` for a paper, the same bytes for the same figure, and say where."""
    files = {kind: stem.with_name(f"{stem.name}.{kind}") for kind in ("png", "pdf")}
    for kind, file in files.items():
        write_atomic(file, encoded(figure, kind, dpi=250))
    return list(files.values())


def encoded(figure: Figure, kind: str, dpi: int) -> bytes:
    """A figure as the bytes of a `png` or `pdf` file, which hold no date."""
    dateless = {"CreationDate": None} if kind == "pdf" else {}
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=dpi, metadata=dateless)
    return buffer.getvalue()


def draw_curve(axes: Axes, name: str, curve: Mapping[str, Any]) -> None:
    """Draw one of them: of `depth` or of `projected`."""
    title, unit = LABELS[name]
    predicted, empirical = curve["predicted"], curve["empirical"]
    values = [value for value in (*predicted, *empirical) if value > 0]
    # whole decades: the labels between them would run into each other
    bounds = (10 ** math.floor(math.log10(min(values))), 10 ** math.ceil(math.log10(max(values))))
    axes.plot(bounds, bounds, "--", color="tab:red", linewidth=1, label="calibrated")
    axes.plot(predicted, empirical, color="tab:blue", label=_words(curve))
    axes.set(xscale="log", yscale="log", xlim=bounds, ylim=bounds, aspect="equal", title=title)
    axes.set_xlabel(f"predicted variance ({unit})")
    axes.set_ylabel(f"mean squared error ({unit})")
    axes.grid(which="both", alpha=0.25)
    axes.legend(frameon=False)  # where no curve is


def _words(curve: Mapping[str, Any]) -> str:
    left_out = f", {curve['left_out']} samples left out" if curve["left_out"] else ""
    return f"window of {curve['window']}{left_out}"

"""Fusion of several cameras: a table with a column per number of cameras and a line per method, and charts."""

import math
from collections.abc import Iterable, Mapping
from functools import partial

from phd_exp.evaluation.fusion import BINS, CALIBRATION, ERRORS, PER_CENT, PROBABILISTIC, FusionScores, Method, place
from phd_exp.evaluation.predictions import Curve
from phd_exp.metrics.bootstrap import Interval
from phd_exp.records.choices import in_words
from phd_exp.reports.charts import Chart, axis, curve_line, identity, line, square
from phd_exp.reports.runs import Report, Run
from phd_exp.reports.table import Table, TableCell, TableRow, bounds, file_stem

NAMES: dict[Method, str] = {
    "mode": "Huber, mode",
    "mean": "Huber, mean",
    "shared": "shared",
    "average": "average",
    "gaussian": "Gaussian",
}
LABELS = {
    "depth_error_mm": "depth (mm)",
    "distance_mm": "distance (mm)",
    **{f"coverage_{level}": f"inside {level} %" for level in PER_CENT},
    "normalised_squared_error": "squared error",
}
COLOURS: dict[Method, int] = {"mode": 1, "mean": 2, "average": 3, "gaussian": 4, "shared": 5}
DASH = {False: "solid", True: "dash"}
MAIN, ASIDE = "line", "aside"
"""Roles: lines that the comparison of two runs includes, and lines that it omits."""
ON_GROUND = ", ground"
STRONG = 0.5  # the smallest correlation that a note reports as a common cause
OF_A_LINE = (
    "Columns: number of cameras of each scene that are fused, starting with the first. Depth: the error along the "
    "first camera's true viewing ray, as in the paper's tables; distance: in space; both means over scenes. In "
    "brackets: 95 % bootstrap intervals over scenes."
)
OF_METHODS = (
    "Huber: the most likely position under the product of the views' Projected Huber densities, and the mean of that "
    "product. Shared: the mean where all views' depths share an unknown factor, as much as in the "
    "other half of the scenes. Average: of the views' modes. Gaussian: the views' means weighted by their "
    "inverse covariances."
)
OF_THE_GROUND = (
    "Ground: every position is also known to lie on a plane through the true one with the normal (0, cos 30°, "
    "sin 30°) in the first camera's frame, the ground in front of a camera that looks down by 30°. The average is "
    "moved to the nearest point of the plane, the Gaussian is conditioned on it."
)


def fusion_tables(report: Report) -> list[Table]:
    """The tables of all runs that recorded several views."""
    return [fusion_table(run, run.measured.fusion) for run in report.runs if run.measured.fusion]


def fusion_table(run: Run, scores: FusionScores) -> Table:
    """The table of a run's scores."""
    apart = "" if (run.data, run.model) == ("scale", "probabilistic") else f"{run.title}, "
    places = (False, True)
    cells = {at: _cell(run, scores, at) for at in scores.bands}
    groups = [_rows(cells, scores.views, quantity, on) for on in places for quantity in ERRORS]
    groups += [[row for name in CALIBRATION for row in _rows(cells, scores.views, name, on)] for on in places]
    return Table(
        stem=file_stem("fusion", run.preset, run.data, run.model, run.name),
        kind="fusion",
        title=f"Fusion, {in_words(run.preset)}, {apart}{run.name}: {scores.n} scenes seen by {scores.views} cameras",
        stub=("quantity", "method"),
        columns=tuple(f"{k} camera{'s' if k > 1 else ''}" for k in range(1, scores.views + 1)),
        groups=tuple(map(tuple, groups)),
        below="exact densities",
        notes=(OF_A_LINE, OF_METHODS, OF_THE_GROUND, *_notes(scores)),
        preset=run.preset,
        cells=tuple(cells.values()),
    )


def _rows(cells: Mapping[str, TableCell], views: int, quantity: str, on_plane: bool) -> list[TableRow]:
    label, cameras = LABELS[quantity] + (ON_GROUND if on_plane else ""), range(1, views + 1)
    return [
        TableRow((label, name), tuple(cells[place(quantity, method, k, on_plane)] for k in cameras))
        for method, name in names_of(quantity).items()
    ]


def names_of(quantity: str) -> Mapping[Method, str]:
    """The methods that have a quantity, and their names."""
    if quantity in ERRORS:
        return NAMES
    return {method: NAMES[method].removesuffix(", mean") for method in PROBABILISTIC}


def _cell(run: Run, scores: FusionScores, at: str) -> TableCell:
    band, exact = scores.bands[at], scores.exact.get(at)
    place = dict(zip(("quantity", "method", "cameras", "ground"), at.split("/"), strict=True))
    numbers = run.choice | {"run": run.name, **place, "mean": band.value, **bounds(band)}
    numbers |= {"exact": exact, "n_scenes": scores.n}
    text, below = band.each(partial(_number, place["quantity"])), "" if exact is None else f"{exact:.1f}"
    return TableCell(text.value, f"({text.low}–{text.high})", below, numbers=(numbers,))


def _number(quantity: str, value: float) -> str:
    if quantity in ERRORS:
        return f"{value:.0f}" if value >= 100 else f"{value:.1f}"
    return f"{value:.2f}" if quantity == "normalised_squared_error" else f"{value:.0f}"


def _notes(scores: FusionScores) -> list[str]:
    levels = ", ".join(map(str, PER_CENT))
    notes = [
        f"Inside {levels} %: per cent of true positions in the ellipsoids of mean and covariance that contain as "
        "much of a Gaussian; below it the share that exact densities have there, whose tails are longer. Squared "
        "error: the squared Mahalanobis distance per dimension, 1 on average where calibrated, above 1 where "
        "overconfident.",
        _common_cause(scores),
    ]
    if scores.left_out:
        notes.append(
            f"{scores.left_out} further scenes are left out: a prediction was not finite, or no position is in front "
            "of every camera."
        )
    return notes


def _common_cause(scores: FusionScores) -> str:
    views, size = scores.correlation, scores.with_size
    text = (
        f"Fusion assumes that the views' errors are independent. Those of log depth of two views of a scene have the "
        f"correlation {views.value:.2f} ({views.low:.2f}–{views.high:.2f})"
    )
    if math.isfinite(size.value):
        text += f", and their average has {size.value:.2f} with log size"
        if abs(size.value) > STRONG:
            text += ": the size of an object, common to its views, shifts all of them"
    last = scores.band("normalised_squared_error", "mean", scores.views)
    verdict = "does not differ from 1 by more than chance"
    if last.low > 1 or last.high < 1:
        verdict = f"means that together they are {'over' if last.low > 1 else 'under'}confident"
    shared = scores.band("normalised_squared_error", "shared", scores.views)
    return (
        f"{text}; the fused squared error of {last.value:.2f} {verdict}. With this part shared, it is "
        f"{shared.value:.2f} ({shared.low:.2f}–{shared.high:.2f})."
    )


def headline(scores: FusionScores) -> str:
    """The depth error with one camera and with all, in words."""
    one, all_ = (_number("depth_error_mm", scores.band("depth_error_mm", "mode", k).value) for k in (1, scores.views))
    return f"depth error {one} mm with one camera, {all_} mm with {scores.views}"


def fusion_charts(scores: FusionScores) -> dict[str, Chart]:
    """Charts of a run that recorded several views."""
    squared = "Fused: squared error over predicted", "squared error / predicted"
    return {
        "fusion_depth_error_mm": _errors(scores, "depth_error_mm", "Depth error by cameras", "mean depth error (mm)"),
        "fusion_distance_mm": _errors(
            scores, "distance_mm", "Distance from the truth by cameras", "mean distance (mm)"
        ),
        "fusion_squared_error": _errors(scores, "normalised_squared_error", *squared),
        "fusion_coverage": _coverage(scores),
        "fusion_surprise": _surprise(scores),
    }


def _errors(scores: FusionScores, quantity: str, title: str, unit: str) -> Chart:
    """An error against the number of cameras: a line for each method, in free space and on the ground."""
    traces, cameras = [], range(1, scores.views + 1)
    for on_plane in (False, True):
        for method, name in names_of(quantity).items():
            curve = _curve(cameras, [scores.band(quantity, method, k, on_plane) for k in cameras])
            role = MAIN if method == "mean" and not on_plane else ASIDE
            name += ON_GROUND if on_plane else ""
            traces.append(curve_line(name, curve, COLOURS[method], DASH[on_plane], role))
    courses = "; ".join(f"{trace['name']} from {trace['y'][0]:.3g} to {trace['y'][-1]:.3g}" for trace in traces)
    text, y = f"{unit} against the number of cameras", axis(unit, log=True)
    if quantity not in ERRORS:
        text = "Squared error of the fused position over its prediction, 1 where calibrated"
        y = axis(unit, rangemode="tozero")
        traces.insert(0, line("calibrated", (1.0, scores.views), (1.0, 1.0), 0, dash="dash", role=ASIDE))
    return Chart(title, f"{text}: {courses}.", traces, {"xaxis": axis("cameras", dtick=1), "yaxis": y})


def _curve(x: Iterable[float], bands: list[Interval[float]], unit: float = 1.0) -> Curve:
    ends = ([getattr(band, end) / unit for band in bands] for end in ("value", "low", "high"))
    return Curve([float(value) for value in x], *ends)


def _coverage(scores: FusionScores) -> Chart:
    traces = [identity(0.0, 1.0, "Gaussian")]
    for k in (1, scores.views):
        for method, alone in names_of("coverage").items():
            bands = [scores.band(f"coverage_{level}", method, k) for level in PER_CENT]
            curve = _curve([level / 100 for level in PER_CENT], bands, unit=100)
            name = f"{alone}, {k} camera{'s' if k > 1 else ''}"
            role = MAIN if (k, method) == (scores.views, "mean") else ASIDE
            traces.append(curve_line(name, curve, COLOURS[method], DASH[k == 1], role))
    shares = "; ".join(f"{one['name']}: {', '.join(f'{100 * y:.0f} %' for y in one['y'])}" for one in traces[1:])
    layout = {"xaxis": axis("share of a Gaussian inside"), "yaxis": axis("share of truths inside")}
    label = f"Share of true positions inside the ellipsoids of {', '.join(map(str, PER_CENT))} %: {shares}."
    return Chart("Fused: coverage of ellipsoids", label, traces, square(layout, 0.0, 1.0))


def _surprise(scores: FusionScores) -> Chart:
    total = sum(scores.surprise) or 1
    x = [(place + 0.5) / BINS for place in range(BINS)]
    trace = line("views", x, [count / total for count in scores.surprise], 1)
    trace["line"]["shape"] = "hvh"
    layout = {
        "xaxis": axis("credible level of the fused position", range=[0, 1]),
        "yaxis": axis("share of views", rangemode="tozero"),
    }
    label = (
        f"Histogram of the credible level that each view gives the position fused from all {scores.views}: "
        f"{100 * scores.surprise[-1] / total:.1f} % of the views find it beyond their "
        f"{100 * (1 - 1 / BINS):.0f} % region. It is low where fusion follows a view, and high where a view is "
        "outvoted."
    )
    return Chart("Surprise of the views", label, [trace], layout)

"""The charts of several views: errors and calibration by the number of cameras, coverage, and surprise."""

from collections.abc import Iterable

from phd_exp.evaluation.fusion import BINS, LEVELS, METHODS, PROBABILISTIC, FusionScores, Method
from phd_exp.evaluation.predictions import Curve
from phd_exp.evaluation.reference import Band
from phd_exp.reports.fusion_table import NAMES, alone
from phd_exp.reports.site.charts import Chart, Trace, axis, curve_line, identity, line, square

COLOURS: dict[Method, int] = {"mode": 1, "mean": 2, "average": 3, "gaussian": 4, "shared": 5}
DASH = {False: "solid", True: "dash"}
MAIN, ASIDE = "line", "aside"
"""Roles: lines that the comparison of two runs includes, and lines that it omits."""


def fusion_charts(scores: FusionScores) -> dict[str, Chart]:
    """Charts of a run that recorded several views."""
    return {
        "fusion_depth_error_mm": _errors(scores, "depth_error_mm", "Depth error", "mean depth error (mm)"),
        "fusion_distance_mm": _errors(scores, "distance_mm", "Distance from the truth", "mean distance (mm)"),
        "fusion_squared_error": _squared_error(scores),
        "fusion_coverage": _coverage(scores),
        "fusion_surprise": _surprise(scores),
    }


def _errors(scores: FusionScores, quantity: str, title: str, unit: str) -> Chart:
    traces = [
        _over_cameras(scores, quantity, method, NAMES[method], on_plane)
        for on_plane in (False, True)
        for method in METHODS
    ]
    label = f"{unit} against the number of cameras: {_courses(traces)}."
    layout = {"xaxis": axis("cameras", dtick=1), "yaxis": axis(unit, log=True)}
    return Chart(f"{title} by cameras", label, traces, layout)


def _squared_error(scores: FusionScores) -> Chart:
    traces = [
        _over_cameras(scores, "normalised_squared_error", method, alone(method), on_plane)
        for on_plane in (False, True)
        for method in PROBABILISTIC
    ]
    label = f"Squared error of the fused position over its prediction, 1 where calibrated: {_courses(traces)}."
    traces.insert(0, line("calibrated", (1.0, scores.views), (1.0, 1.0), 0, dash="dash", role=ASIDE))
    layout = {"xaxis": axis("cameras", dtick=1), "yaxis": axis("squared error / predicted", rangemode="tozero")}
    return Chart("Fused: squared error over predicted", label, traces, layout)


def _over_cameras(scores: FusionScores, quantity: str, method: Method, name: str, on_plane: bool) -> Trace:
    cameras = range(1, scores.views + 1)
    curve = _curve(cameras, [scores.band(quantity, method, k, on_plane) for k in cameras])
    role = MAIN if method == "mean" and not on_plane else ASIDE
    return curve_line(name + (", ground" if on_plane else ""), curve, COLOURS[method], DASH[on_plane], role)


def _curve(x: Iterable[float], bands: list[Band], unit: float = 1.0) -> Curve:
    ends = ([getattr(band, end) / unit for band in bands] for end in ("value", "low", "high"))
    return Curve([float(value) for value in x], *ends)


def _courses(traces: list[Trace]) -> str:
    return "; ".join(f"{trace['name']} from {trace['y'][0]:.3g} to {trace['y'][-1]:.3g}" for trace in traces)


def _coverage(scores: FusionScores) -> Chart:
    traces = [identity(0.0, 1.0, "Gaussian")]
    for k in (1, scores.views):
        for method in PROBABILISTIC:
            bands = [scores.band(f"coverage_{level}", method, k) for level in LEVELS]
            curve = _curve([level / 100 for level in LEVELS], bands, unit=100)
            name = f"{alone(method)}, {k} camera{'s' if k > 1 else ''}"
            role = MAIN if (k, method) == (scores.views, "mean") else ASIDE
            traces.append(curve_line(name, curve, COLOURS[method], DASH[k == 1], role))
    shares = "; ".join(
        f"{trace['name']}: {', '.join(f'{100 * y:.0f} %' for y in trace['y'])}" for trace in traces[1:]
    )
    layout = {"xaxis": axis("share of a Gaussian inside"), "yaxis": axis("share of truths inside")}
    label = f"Share of true positions inside the ellipsoids of {', '.join(map(str, LEVELS))} %: {shares}."
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

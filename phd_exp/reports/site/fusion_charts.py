"""The charts of several views: does the error fall with the cameras, is the fused calibrated, who is surprised?"""

from phd_exp.evaluation.fusion import BINS, LEVELS, METHODS, PROBABILISTIC, FusionScores, Method
from phd_exp.evaluation.reference import Band
from phd_exp.reports.fusion_table import NAMES
from phd_exp.reports.site.charts import Chart, Trace, axis, identity, line, square

COLOURS: dict[Method, int] = {"mode": 1, "mean": 2, "average": 3, "gaussian": 4}
GROUND = {False: "", True: ", ground"}
DASH = {False: "solid", True: "dash"}
MAIN, ASIDE = "line", "aside"
"""Roles: what the comparison of two runs shows of a chart, and what it leaves out."""


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
        _over_cameras(scores, quantity, method, on_plane) for on_plane in (False, True) for method in METHODS
    ]
    said = "; ".join(_course(trace) for trace in traces)
    layout = {"xaxis": axis("cameras", dtick=1), "yaxis": axis(unit, log=True)}
    return Chart(f"{title} by cameras", f"{unit} against the number of cameras: {said}.", traces, layout)


def _squared_error(scores: FusionScores) -> Chart:
    traces = [
        _over_cameras(scores, "normalised_squared_error", method, on_plane)
        for on_plane in (False, True)
        for method in PROBABILISTIC
    ]
    said = "; ".join(_course(trace) for trace in traces)
    ends = (1.0, float(scores.views))
    traces.insert(0, line("calibrated", ends, (1.0, 1.0), 0, dash="dash", role=ASIDE))
    layout = {
        "xaxis": axis("cameras", dtick=1),
        "yaxis": axis("squared error / predicted", rangemode="tozero"),
    }
    label = f"Squared error of the fused position over what is predicted, 1 where calibrated: {said}."
    return Chart("Fused: squared error over predicted", label, traces, layout)


def _coverage(scores: FusionScores) -> Chart:
    x = [level / 100 for level in LEVELS]
    traces = [identity(0.0, 1.0, "Gaussian")]
    for k in (1, scores.views):
        for method in PROBABILISTIC:
            bands = [scores.band(f"coverage_{level}", method, k) for level in LEVELS]
            name = f"{_name(method)}, {k} camera{'s' if k > 1 else ''}"
            shown = [Band(band.value / 100, band.low / 100, band.high / 100) for band in bands]
            role = MAIN if (k, method) == (scores.views, "mean") else ASIDE
            traces.append(_line(name, x, shown, COLOURS[method], DASH[k == 1], role))
    said = "; ".join(
        f"{trace['name']}: {', '.join(f'{100 * y:.0f} %' for y in trace['y'])}" for trace in traces[1:]
    )
    layout = {"xaxis": axis("share of a Gaussian inside"), "yaxis": axis("share of truths inside")}
    label = f"Share of true positions inside the ellipsoids of {', '.join(map(str, LEVELS))} %: {said}."
    return Chart("Fused: coverage of ellipsoids", label, traces, square(layout, 0.0, 1.0))


def _surprise(scores: FusionScores) -> Chart:
    total = sum(scores.surprise) or 1
    x = [(place + 0.5) / BINS for place in range(BINS)]
    trace = line("views", x, [count / total for count in scores.surprise], 1)
    trace["line"]["shape"] = "hvh"
    beyond = 100 * scores.surprise[-1] / total
    layout = {
        "xaxis": axis("credible level of the fused position", range=[0, 1]),
        "yaxis": axis("share of views", rangemode="tozero"),
    }
    label = (
        f"Histogram of the credible level that each view gives the position fused from all {scores.views}: "
        f"{beyond:.1f} % of the views find it beyond their {100 * (1 - 1 / BINS):.0f} % region. It is low where "
        "fusion follows a view, and high where a view is outvoted."
    )
    return Chart("Surprise of the views", label, [trace], layout)


def _over_cameras(scores: FusionScores, quantity: str, method: Method, on_plane: bool) -> Trace:
    cameras = range(1, scores.views + 1)
    bands = [scores.band(quantity, method, k, on_plane) for k in cameras]
    name = NAMES[method] if quantity != "normalised_squared_error" else _name(method)
    role = MAIN if method == "mean" and not on_plane else ASIDE
    x = [float(k) for k in cameras]
    return _line(name + GROUND[on_plane], x, bands, COLOURS[method], DASH[on_plane], role)


def _line(name: str, x: list[float], bands: list[Band], colour: int, dash: str, role: str) -> Trace:
    low, high = [band.low for band in bands], [band.high for band in bands]
    return line(name, x, [band.value for band in bands], colour, dash=dash, role=role, low=low, high=high)


def _name(method: Method) -> str:
    """Where a method has one line alone."""
    return NAMES[method].removesuffix(", mean")


def _course(trace: Trace) -> str:
    return f"{trace['name']} from {trace['y'][0]:.3g} to {trace['y'][-1]:.3g}"

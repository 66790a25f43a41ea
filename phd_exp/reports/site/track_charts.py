"""The charts of paths: errors and calibration over the time of a sequence."""

from collections.abc import Mapping

from phd_exp.evaluation.tracks import ERRORS, METHODS, NEES, Method, TrackScores, place
from phd_exp.reports.site.charts import Chart, Numbers, Trace, axis, curve_line, line
from phd_exp.reports.tracks_table import NAMES

COLOURS: dict[Method, int] = {"slow": 1, "kalman": 2, "independent": 3, "single": 4}
DASHES: dict[Method, str] = {"slow": "solid", "kalman": "dash", "independent": "dot", "single": "dashdot"}
TITLES = {
    ERRORS[0]: ("Depth error", "mean depth error (mm)"),
    ERRORS[1]: ("Projected error", "mean projected error (mm)"),
}
SQUARED = "squared error / predicted"


def track_charts(scores: Mapping[str, TrackScores]) -> dict[str, Chart]:
    """Both errors and the squared error over predicted, for each length of sequences."""
    charts = {}
    for one in sorted(scores.values(), key=lambda each: each.frames):
        for quantity, (title, unit) in TITLES.items():
            y = axis(unit, rangemode="tozero")
            charts[f"tracks_{quantity}_{one.frames}"] = _over_time(one, quantity, f"{title}, {one.frames} frames", y)
        chart = _over_time(one, NEES, f"Squared error over predicted, {one.frames} frames", axis(SQUARED, log=True))
        low, high = one.calibrated
        times = one.curves[place(NEES, "slow")].x
        band = line("calibrated", times, [1.0] * len(times), 0, dash="dash", role="aside", low=[low] * len(times),
                    high=[high] * len(times))  # fmt: skip
        chart.data.insert(0, band)
        charts[f"tracks_{NEES}_{one.frames}"] = chart
    return charts


def _over_time(scores: TrackScores, quantity: str, title: str, y: Trace) -> Chart:
    traces = []
    for method in METHODS:
        curve, role = scores.curves[place(quantity, method)], "line" if method == "slow" else "aside"
        traces.append(curve_line(NAMES[method], curve, COLOURS[method], DASHES[method], role))
    ends = "; ".join(f"{trace['name']} {_mean(trace['y']):.3g}" for trace in traces)
    label = f"{title}, over the time of {scores.n} sequences, on average: {ends}."
    return Chart(title, label, traces, {"xaxis": axis("time (s)"), "yaxis": y})


def _mean(values: Numbers) -> float:
    known = [value for value in values if value is not None]
    return sum(known) / max(len(known), 1)

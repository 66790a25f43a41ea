"""Paths over time: a table with a column per length of the sequences and a line per method, and charts."""

from collections.abc import Mapping

from phd_exp.evaluation.tracks import ERRORS, HIDDEN, METHODS, NEES, SMOOTHERS, Method, TrackScores, place
from phd_exp.records.choices import in_words
from phd_exp.reports.charts import Chart, Numbers, Trace, axis, curve_line, line
from phd_exp.reports.runs import Report, Run
from phd_exp.reports.table import NOTHING, Table, TableCell, TableRow, bounds, file_stem

NAMES: dict[Method, str] = {
    "single": "single frames",
    "kalman": "Kalman (RTS)",
    "independent": "ours, independent frames",
    "slow": "ours, weighted frames",
}
LABELS = {
    "depth_error_mm": "depth (mm)",
    "projected_error_mm": "projected (mm)",
    "hidden/depth_error_mm": "depth, hidden (mm)",
    "hidden/projected_error_mm": "projected, hidden (mm)",
    "ratio/depth_error_mm": "depth / single",
    "ratio/hidden/depth_error_mm": "depth / single, hidden",
    "gain": "depth, less than Kalman (mm)",
    NEES: "squared error",
}
"""Quantity -> its label; the errors, then comparisons, then calibration."""
COLOURS: dict[Method, int] = {"slow": 1, "kalman": 2, "independent": 3, "single": 4}
DASHES: dict[Method, str] = {"slow": "solid", "kalman": "dash", "independent": "dot", "single": "dashdot"}
TITLES = {
    ERRORS[0]: ("Depth error", "mean depth error (mm)"),
    ERRORS[1]: ("Projected error", "mean projected error (mm)"),
}
SQUARED = "squared error / predicted"
OF_QUANTITIES = (
    "Means over the frames of all sequences; in brackets: 95 % bootstrap intervals over sequences. "
    "Depth: along the camera's true viewing ray; projected: across it, as in the paper's tables. Hidden: frames in "
    f"which less than {100 * HIDDEN:.0f} % of the object is visible. Ratios are those of mean errors. Squared error: "
    "the squared Mahalanobis distance per dimension, averaged over the path, 1 where calibrated, above 1 where "
    "overconfident."
)
OF_METHODS = (
    "Single frames: the mode of each; with two cameras, the position fused from both. Kalman (RTS): a "
    "Rauch-Tung-Striebel smoother of the frames' means and "
    "covariances. Ours: the mean path under the frames' densities; weighted frames: each density has a "
    "weight, the information that neighbouring frames lack. All assume a velocity that changes by white noise."
)


def tracks_tables(report: Report) -> list[Table]:
    """The tables of all runs that recorded sequences."""
    return [tracks_table(run, run.measured.tracks) for run in report.runs if run.measured.tracks]


def tracks_table(run: Run, scores: Mapping[str, TrackScores]) -> Table:
    """The table of a run's scores, by the frames of a sequence."""
    every = sorted(scores.values(), key=lambda one: (one.frames, one.cameras))
    by_cameras = {one.cameras: one for one in every}
    found = {
        quantity: tuple(
            TableRow((label, NAMES[method]), tuple(_cell(run, one, quantity, method) for one in every))
            for method in METHODS
            if any(place(quantity, method) in one.bands for one in every)
        )
        for quantity, label in LABELS.items()
    }
    return Table(
        stem=file_stem("tracks", run.preset, run.data, run.model, run.name),
        kind="tracks",
        title=f"Paths, {in_words(run.preset)}, {run.title}, {run.name}",
        stub=("quantity", "method"),
        columns=tuple(f"{one.n} × {one.name}" for one in every),
        groups=tuple(rows for rows in found.values() if rows),
        notes=(OF_QUANTITIES, OF_METHODS, *map(_chosen, by_cameras.values()), *map(_frames, every)),
        preset=run.preset,
    )


def _cell(run: Run, scores: TrackScores, quantity: str, method: Method) -> TableCell:
    band = scores.bands.get(place(quantity, method))
    if band is None:
        return TableCell(NOTHING)
    numbers = run.choice | {"run": run.name, "frames": scores.frames, "cameras": scores.cameras}
    numbers |= {"quantity": quantity, "method": method, "mean": band.value, **bounds(band)}
    numbers |= {"n_sequences": scores.n, "n_hidden": scores.hidden}
    text = band.each(lambda value: number(quantity, value))
    return TableCell(text.value, f"({text.low}{' to ' if band.low < 0 else '–'}{text.high})", numbers=(numbers,))


def number(quantity: str, value: float) -> str:
    """A score as text."""
    if quantity in (NEES, *(label for label in LABELS if label.startswith("ratio"))):
        return f"{value:.2f}"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}"


def _chosen(scores: TrackScores) -> str:
    noise, slow, whole = scores.choice.noise, scores.choice.slow, scores.choice.correlated
    noises = ", ".join(f"{noise[method]:.2g} ({NAMES[method]})" for method in SMOOTHERS)
    return (
        f"Held-out sequences from {_cameras(scores.cameras)} have a speed of {scores.choice.speed:.2g} m/s. They "
        f"determine the noise of the motion, in m/s² per √Hz: {noises}. Their errors have the time constants "
        f"{whole.depth_time:.2g} s of depth and {whole.projection_time:.2g} s of the projection by autocorrelation; "
        f"weighted frames use {slow.depth_time:.2g} s and {slow.projection_time:.2g} s, with which the true held-out "
        "positions were most likely."
    )


def _cameras(n: int) -> str:
    return "one camera" if n == 1 else f"{n} cameras"


def _frames(scores: TrackScores) -> str:
    left = f" {scores.left_out} further sequences are left out." if scores.left_out else ""
    n = scores.n * scores.frames
    return f"{scores.hidden} of {n} frames of the sequences of {scores.name} hide the object.{left}"


def headline(scores: Mapping[str, TrackScores]) -> str:
    """The depth error of single frames and of the path, in words."""
    one = min(scores.values(), key=lambda each: (each.frames, each.cameras))
    single, path = (number(ERRORS[0], one.bands[place(ERRORS[0], method)].value) for method in ("single", "slow"))
    return f"depth error {single} mm in single frames, {path} mm on paths of {one.frames}"


def track_charts(scores: Mapping[str, TrackScores]) -> dict[str, Chart]:
    """Both errors and the squared error over predicted, for each length of sequences."""
    charts = {}
    for key, one in scores.items():
        for quantity, (title, unit) in TITLES.items():
            y = axis(unit, rangemode="tozero")
            charts[f"tracks_{quantity}_{key}"] = _over_time(one, quantity, f"{title}, {one.name}", y)
        chart = _over_time(one, NEES, f"Squared error over predicted, {one.name}", axis(SQUARED, log=True))
        low, high = one.calibrated
        times = one.curves[place(NEES, "slow")].x
        band = line("calibrated", times, [1.0] * len(times), 0, dash="dash", role="aside", low=[low] * len(times),
                    high=[high] * len(times))  # fmt: skip
        chart.data.insert(0, band)
        charts[f"tracks_{NEES}_{key}"] = chart
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

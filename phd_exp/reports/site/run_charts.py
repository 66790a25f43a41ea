"""The charts of one run: calibration, training, errors by stratum, several cameras, and paths."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from phd_exp.evaluation import fusion, tracks
from phd_exp.evaluation.fusion import BINS, PER_CENT, PROBABILISTIC, FusionScores
from phd_exp.evaluation.predictions import Curve, Evaluation, Stratum
from phd_exp.evaluation.tracks import TrackScores, place
from phd_exp.metrics.bootstrap import Interval
from phd_exp.reports.charts import DASHES, Chart, axis, bar_chart, bars, chart, curve_line, identity, line, square
from phd_exp.reports.figures import decades
from phd_exp.reports.numbers import cameras
from phd_exp.reports.quantities import METHODS, METRICS, SCORES
from phd_exp.reports.runs import Run

_KEPT = "share of predictions kept, surest first"
_CALIBRATION: Mapping[str, tuple[str, str, str]] = {
    "depth_calibration": ("Calibration of depth", "predicted variance (m²)", "mean squared error (m²)"),
    "projected_calibration": (
        "Calibration of the projected position",
        "predicted variance of (x, y)/z",
        "mean squared error of (x, y)/z",
    ),
    "coverage": ("Coverage of credible regions", "credible level", "share of truths inside"),
    "depth_pit": ("Depth PIT", "PIT of the true depth", "share of samples below"),
    "depth_risk_coverage": ("Depth: risk and coverage", _KEPT, "mean error of depth (mm)"),
    "projected_risk_coverage": ("Projection: risk and coverage", _KEPT, "mean error of (x, y)/z (mrad)"),
}
"""Curve of an evaluation -> title, and the names of its axes."""
_OVER_EPOCHS = ("depth_ence", "projected_ence", "miscalibration_area", "depth_pit_area")
_OF_FUSION = {"depth_error_mm": True, "distance_mm": True, "normalised_squared_error": False}
"""Quantity over the number of cameras -> whether its axis is logarithmic."""
_OF_TRACKS = {"depth_error_mm": False, "projected_error_mm": False, "nees": True}
_COLOURS = {"mode": 1, "mean": 2, "average": 3, "gaussian": 4, "shared": 5}
_COLOURS_OF_PATHS = {"slow": 1, "kalman": 2, "independent": 3, "single": 4}
_MAIN, _ASIDE = "line", "aside"
"""Roles: lines that the comparison of two runs includes, and lines that it omits."""


def run_charts(run: Run) -> dict[str, dict[str, Chart]]:
    """The charts of a run by the section of its page, without empty sections."""
    found = run.measured
    sections = {
        "calibration": calibration_charts(found.before, found.after) if found.before else {},
        "learning": dict(_learning(run)),
        "strata": dict(_strata(found.before.strata)) if found.before else {},
        "fusion": dict(_fusion(found.fusion)) if found.fusion else {},
        "tracks": {key: made for name, one in found.tracks.items() for key, made in _paths(name, one)},
    }
    return {name: charts for name, charts in sections.items() if charts}


def calibration_charts(before: Evaluation, after: Evaluation | None) -> dict[str, Chart]:
    """The six charts of a distribution, of the predictions as recorded and after recalibration."""
    recalibrated = after.curves if after else {}
    return {
        key: _calibration(key, before.curves[key], None if "risk" in key else recalibrated.get(key))
        for key in _CALIBRATION
        if key in before.curves
    }


def _calibration(key: str, before: Curve, after: Curve | None) -> Chart:
    title, x, y = _CALIBRATION[key]
    log = key.endswith("_calibration")
    traces = [curve_line("as predicted" if after else "predictions", before, 1, "solid", "before")]
    traces += [curve_line("recalibrated", after, 2, "dash", "after")] if after else []
    if "risk" in key:
        return chart(title, traces, axis(x), axis(y, rangemode="tozero"))
    ends = (decades([*before.x, *before.y]) or (0.1, 1.0)) if log else (0.0, 1.0)
    made = chart(title, traces, axis(x, log), axis(y, log))
    return replace(made, data=[identity(*ends, "calibrated"), *traces], layout=square(made.layout, *ends))


def _learning(run: Run) -> Iterator[tuple[str, Chart]]:
    """A chart per metric, of training and test split over the epochs, and one of the errors of calibration."""
    x = axis("epochs of training")
    for key, metric in METRICS.items():
        traces = [
            line(split, run.epochs, run.metrics[f"{split}/{key}"], colour, dash=dash, role=split)
            for split, colour, dash in (("test", 1, "solid"), ("train", 2, "dot"))
            if _is_a_course(run, f"{split}/{key}")
        ]
        if traces:
            y = axis(metric.axis, log=key not in ("nll", "loss"))
            yield f"learning_{key}", chart(f"{metric.label} over training", traces, x, y)
    known = [key for key in _OVER_EPOCHS if _is_a_course(run, f"test/calibration/{key}")]
    traces = [
        line(SCORES[key].label, run.epochs, run.metrics[f"test/calibration/{key}"], i + 1, dash=DASHES[i])
        for i, key in enumerate(known)
    ]
    if traces:
        y = axis("calibration error", rangemode="tozero")
        yield "learning_calibration", chart("Calibration over training", traces, x, y)


def _is_a_course(run: Run, key: str) -> bool:
    """Whether a metric has two values or more, which a failed run may not have."""
    return sum(value is not None for value in run.metrics.get(key, ())) > 1


def _strata(every: Sequence[Stratum]) -> Iterator[tuple[str, Chart]]:
    """Both errors of the tables by each quantity with more than one stratum."""
    for name in dict.fromkeys(stratum.quantity for stratum in every):
        strata = [stratum for stratum in every if stratum.quantity == name]
        # an en dash between two numbers
        labels = [re.sub(r"(?<=\d)-(?=\d)", "–", stratum.label.removeprefix(f"{name} ")) for stratum in strata]
        for key, colour in (("projected_error_mm", 1), ("depth_error_mm", 2)) if len(strata) > 1 else ():
            score, bands = SCORES[key], [stratum.scores[key] for stratum in strata]
            value, low, high = zip(*((band.value, band.low, band.high) for band in bands), strict=True)
            trace = bars(score.label, value, labels, colour, low, high)
            trace["meta"]["n"] = [stratum.n for stratum in strata]
            x = axis(score.axis, rangemode="tozero", nticks=4)
            made = bar_chart(f"{score.label} by {name}", trace, x, name)
            yield f"strata_{name}_{key}".replace(" ", "_"), made


def _fusion(scores: FusionScores) -> Iterator[tuple[str, Chart]]:
    """Errors over the number of cameras, in free space and on the ground; coverage, and surprise of the views."""
    every = list(range(1, scores.views + 1))
    for quantity, log in _OF_FUSION.items():
        score, traces = SCORES[quantity], []
        for on_plane in (False, True):
            for method in _COLOURS:
                bands = [scores.bands.get(fusion.place(quantity, method, k, on_plane)) for k in every]
                if all(bands):
                    name = METHODS[method] + (", ground" if on_plane else "")
                    role = _MAIN if method == "mean" and not on_plane else _ASIDE
                    traces.append(curve_line(name, _curve(every, bands), _COLOURS[method], DASHES[on_plane], role))
        if not log:
            calibrated = line("calibrated", (1.0, scores.views), (1.0, 1.0), 0, dash="dash", role=_ASIDE)
            traces.insert(0, calibrated)
        y = axis(score.axis, log=log, **({} if log else {"rangemode": "tozero"}))
        key = "squared_error" if quantity == "normalised_squared_error" else quantity
        yield f"fusion_{key}", chart(f"{score.label} by cameras", traces, axis("cameras", dtick=1), y)
    traces = [
        curve_line(
            f"{METHODS[method]}, {cameras(k)}",
            _curve([p / 100 for p in PER_CENT], [scores.band(f"coverage_{p}", method, k) for p in PER_CENT], 100),
            _COLOURS[method], DASHES[k == 1], _MAIN if (k, method) == (scores.views, "mean") else _ASIDE,
        )
        for k in dict.fromkeys((1, scores.views))
        for method in PROBABILISTIC
    ]  # fmt: skip
    made = chart(
        "Fused: coverage of ellipsoids", traces, axis("share of a Gaussian inside"), axis("share of truths inside")
    )
    layout = square(made.layout, 0.0, 1.0)
    yield "fusion_coverage", replace(made, data=[identity(0.0, 1.0, "Gaussian"), *traces], layout=layout)
    total = sum(scores.surprise) or 1
    x = [(bin + 0.5) / BINS for bin in range(BINS)]
    trace = line("views", x, [count / total for count in scores.surprise], 1)
    trace["line"]["shape"] = "hvh"
    x_axis = axis("credible level of the fused position", range=[0, 1])
    y = axis("share of views", rangemode="tozero")
    yield "fusion_surprise", chart("Surprise of the views", [trace], x_axis, y)


def _curve(x: Sequence[float], bands: Sequence[Interval[float] | None], unit: float = 1.0) -> Curve:
    ends = ([getattr(band, end) / unit for band in bands] for end in ("value", "low", "high"))
    return Curve([float(value) for value in x], *ends)


def _paths(key: str, scores: TrackScores) -> Iterator[tuple[str, Chart]]:
    """Both errors and the squared error over predicted over the time of the sequences."""
    for quantity, log in _OF_TRACKS.items():
        score = SCORES["normalised_squared_error" if quantity == tracks.NEES else quantity]
        traces = [
            curve_line(
                METHODS[method], scores.curves[place(quantity, method)], _COLOURS_OF_PATHS[method],
                DASHES[_COLOURS_OF_PATHS[method] - 1], _MAIN if method == "slow" else _ASIDE,
            )
            for method in tracks.METHODS
        ]  # fmt: skip
        if quantity == tracks.NEES:
            times, (low, high) = scores.curves[place(quantity, "slow")].x, scores.calibrated
            n = len(times)
            calibrated = line(
                "calibrated", times, [1.0] * n, 0, dash="dash", role=_ASIDE, low=[low] * n, high=[high] * n
            )
            traces.insert(0, calibrated)
        y = axis(score.axis, log=log, **({} if log else {"rangemode": "tozero"}))
        yield f"tracks_{quantity}_{key}", chart(f"{score.label}, {scores.name}", traces, axis("time (s)"), y)

"""The charts of one run: calibration, training, and errors by stratum; those of other records from their files."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from phd_exp.evaluation.predictions import Curve, Evaluation, Stratum
from phd_exp.reports.charts import DASHES, Chart, Trace, axis, bars, curve_line, identity, line, square
from phd_exp.reports.figures import decades
from phd_exp.reports.fusion import fusion_charts
from phd_exp.reports.quantities import METRICS, SCORES, Quantity
from phd_exp.reports.runs import Run
from phd_exp.reports.tracks import track_charts


def run_charts(run: Run) -> dict[str, dict[str, Chart]]:
    """The charts of a run by the section of its page, without empty sections."""
    before, after, fusion = run.measured.before, run.measured.after, run.measured.fusion
    sections = {
        "calibration": calibration_charts(before, after) if before else {},
        "learning": learning_charts(run),
        "strata": strata_charts(before) if before else {},
        "fusion": fusion_charts(fusion) if fusion else {},
        "tracks": track_charts(run.measured.tracks),
    }
    return {name: charts for name, charts in sections.items() if charts}


def calibration_charts(before: Evaluation, after: Evaluation | None) -> dict[str, Chart]:
    """The six charts of a distribution, of the predictions as recorded and after recalibration."""
    recalibrated = after.curves if after else {}
    return {
        key: _calibration_chart(kind, before.curves[key], recalibrated.get(key) if kind.diagonal else None)
        for key, kind in _KINDS.items()
        if key in before.curves
    }


@dataclass(frozen=True)
class _Kind:
    title: str
    x: str
    y: str
    diagonal: bool = True
    log: bool = False


_KEPT = "share of predictions kept, surest first"
_KINDS = {
    "depth_calibration": _Kind(
        "Calibration of depth", "predicted variance (m²)", "mean squared error (m²)", log=True
    ),
    "projected_calibration": _Kind(
        "Calibration of the projected position",
        "predicted variance of (x, y)/z",
        "mean squared error of (x, y)/z",
        log=True,
    ),
    "coverage": _Kind("Coverage of credible regions", "credible level", "share of truths inside"),
    "depth_pit": _Kind("Depth PIT", "PIT of the true depth", "share of samples below"),
    "depth_risk_coverage": _Kind("Depth: risk and coverage", _KEPT, "mean error of depth (mm)", diagonal=False),
    "projected_risk_coverage": _Kind(
        "Projection: risk and coverage", _KEPT, "mean error of (x, y)/z (mrad)", diagonal=False
    ),
}


def _calibration_chart(kind: _Kind, before: Curve, after: Curve | None) -> Chart:
    traces = [curve_line("as predicted" if after else "predictions", before, 1, "solid", "before")]
    label = f"{kind.title}: {kind.y} against {kind.x}. {_in_words(kind, before)}"
    if after:
        traces.append(curve_line("recalibrated", after, 2, "dash", "after"))
        label += f" Recalibrated: {_in_words(kind, after)}"
    layout = {"xaxis": axis(kind.x, kind.log), "yaxis": axis(kind.y, kind.log)}
    if kind.diagonal:
        ends = (decades([*before.x, *before.y]) or (0.1, 1.0)) if kind.log else (0.0, 1.0)
        traces.insert(0, identity(*ends, "calibrated"))
        layout = square(layout, *ends)
    else:
        layout["yaxis"] |= {"rangemode": "tozero"}
    return Chart(kind.title, label, traces, layout)


def _in_words(kind: _Kind, curve: Curve) -> str:
    points = list(zip(curve.x, curve.y, strict=True))
    if kind.log:
        ratios = sorted(y / x for x, y in points if x > 0 and y > 0)
        middle = f"{ratios[len(ratios) // 2]:.2g}" if ratios else "unknown"
        return f"The squared error is {middle} times the predicted variance in the median; 1 is calibrated."
    if not points:
        return "No points."
    if kind.diagonal:
        x, y = max(points, key=lambda point: abs(point[1] - point[0]))
        return f"Furthest from the diagonal at {x:.2f}, where the share is {y:.2f}."
    _, half = min(points, key=lambda point: abs(point[0] - 0.5))
    return f"The surer half has {half:.3g}, all predictions have {curve.y[-1]:.3g}."


_OVER_EPOCHS = ("depth_ence", "projected_ence", "miscalibration_area", "depth_pit_area")


def learning_charts(run: Run) -> dict[str, Chart]:
    """A chart per metric, of training and test split over the epochs, and one of the errors of calibration."""
    charts = {}
    for key, metric in METRICS.items():
        traces = [
            line(split, run.epochs, run.metrics[f"{split}/{key}"], colour, dash=dash, role=split)
            for split, colour, dash in (("test", 1, "solid"), ("train", 2, "dot"))
            if _is_a_course(run, f"{split}/{key}")
        ]
        if traces:
            title, y = f"{metric.label} over training", axis(metric.axis, log=key not in ("nll", "loss"))
            charts[f"learning_{key}"] = _over_epochs(title, metric.axis, y, traces, [metric] * len(traces))
    if known := [key for key in _OVER_EPOCHS if _is_a_course(run, f"test/calibration/{key}")]:
        traces = [
            line(SCORES[key].label, run.epochs, run.metrics[f"test/calibration/{key}"], i + 1, dash=DASHES[i])
            for i, key in enumerate(known)
        ]
        title, y = "Calibration over training", axis("calibration error", rangemode="tozero")
        scores = [SCORES[key] for key in known]
        charts["learning_calibration"] = _over_epochs(title, "Calibration errors", y, traces, scores)
    return charts


def _is_a_course(run: Run, key: str) -> bool:
    """Whether a metric has two values or more, which a failed run may not have."""
    return sum(value is not None for value in run.metrics.get(key, ())) > 1


def _over_epochs(title: str, what: str, y: Trace, traces: list[Trace], scores: Sequence[Quantity]) -> Chart:
    label = f"{what} over the epochs: {'; '.join(map(_course, traces, scores))}."
    return Chart(title, label, traces, {"xaxis": axis("epochs of training"), "yaxis": y})


def _course(trace: Trace, metric: Quantity) -> str:
    known = [(x, y) for x, y in zip(trace["x"], trace["y"], strict=True) if y is not None]
    if not known:
        return f"{trace['name']}: no values"
    (start, first), (end, last) = known[0], known[-1]
    return f"{trace['name']} from {metric.text(first)} at epoch {start:g} to {metric.text(last)} at epoch {end:g}"


def strata_charts(evaluation: Evaluation) -> dict[str, Chart]:
    """Both errors of the tables by each quantity with more than one stratum."""
    charts = {}
    for name in dict.fromkeys(stratum.quantity for stratum in evaluation.strata):
        strata = [stratum for stratum in evaluation.strata if stratum.quantity == name]
        if len(strata) > 1:
            for key, colour in (("projected_error_mm", 1), ("depth_error_mm", 2)):
                charts[f"strata_{name}_{key}".replace(" ", "_")] = _strata_chart(strata, name, key, colour)
    return charts


def _strata_chart(strata: Sequence[Stratum], name: str, key: str, colour: int) -> Chart:
    score = SCORES[key]
    bands = [stratum.scores[key] for stratum in strata]
    # an en dash between two numbers
    labels = [re.sub(r"(?<=\d)-(?=\d)", "–", stratum.label.removeprefix(f"{name} ")) for stratum in strata]
    lows, highs = [band.low for band in bands], [band.high for band in bands]
    trace = bars(score.label, [band.value for band in bands], labels, colour, lows, highs)
    trace["meta"]["n"] = [stratum.n for stratum in strata]
    values = (f"{text}: {score.text(band.value)} {score.unit}" for text, band in zip(labels, bands, strict=True))
    layout = {
        "xaxis": axis(score.axis, rangemode="tozero", nticks=4),
        "yaxis": axis(name) | {"type": "category", "autorange": "reversed"},
    }
    return Chart(f"{score.label} by {name}", f"{score.label} by {name}: {'; '.join(values)}.", [trace], layout)

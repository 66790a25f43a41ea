"""Charts of all runs together, from the charts of each."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from phd_exp.reports.paper import PUBLISHED
from phd_exp.reports.site.charts import DASHES, Chart, Trace, axis, identity, square
from phd_exp.reports.site.quantities import METRICS, Quantity
from phd_exp.reports.site.run_data import RunData

COLOURS = 7
CALIBRATION = ("depth_calibration", "projected_calibration", "coverage", "depth_pit")
PRECISION = ("depth_precision", "projected_precision")
LEARNING = ("projected_error_mm", "depth_error_mm", "nll")


@dataclass(frozen=True)
class Key:
    """One entry of a legend: what a colour, a dash or both stand for."""

    label: str
    colour: int
    dash: str = "solid"


@dataclass(frozen=True)
class Group:
    """Charts that share a legend."""

    charts: dict[str, Chart]
    legend: list[Key]


def overview_groups(runs: Sequence[RunData]) -> dict[str, Group]:
    """Calibration, precision and learning curves, a line a run; a group that would be empty is left out."""
    colours = Colours(runs)
    groups = {
        "calibration": {key: _calibration(runs, key, colours) for key in CALIBRATION},
        "precision": {key: _precision(runs, key, colours) for key in PRECISION},
        "learning": {key: _learning(runs, key, colours) for key in LEARNING},
    }
    found = {
        name: {f"{name}_{key}": chart for key, chart in charts.items() if chart}
        for name, charts in groups.items()
    }
    legends = {
        "calibration": [Key("calibrated", 0, "dash"), *colours.of_data(runs, dashed=True)],
        "precision": [*colours.of_data(runs, dashed=False), Key("test", 0), Key("train", 0, "dot")],
        "learning": [*colours.of_models(runs), *colours.dashes_of_data(runs)],
    }
    return {name: Group(charts, legends[name]) for name, charts in found.items() if charts}


class Colours:
    """A colour and a dash for each data set and each model, the paper's first and always the same."""

    def __init__(self, runs: Iterable[RunData]) -> None:
        runs = list(runs)
        self.data = _places([data for _, data in PUBLISHED], (run.data for run in runs))
        self.models = _places([model for model, _ in PUBLISHED], (run.model for run in runs))

    def of_data(self, runs: Iterable[RunData], dashed: bool) -> list[Key]:
        """The keys of a legend of data sets, of those that have a calibration curve."""
        there = {run.data for run in runs if "depth_calibration" in run.charts}
        return [
            Key(name, self.colour(place), self.dash(place) if dashed else "solid")
            for name, place in self.data.items()
            if name in there
        ]

    def of_models(self, runs: Iterable[RunData]) -> list[Key]:
        """The keys of a legend of models."""
        there = {run.model for run in runs}
        return [Key(name, self.colour(place)) for name, place in self.models.items() if name in there]

    def dashes_of_data(self, runs: Iterable[RunData]) -> list[Key]:
        """The keys of a legend in which data sets differ by their dashes alone."""
        there = {run.data for run in runs}
        return [Key(name, 0, self.dash(place)) for name, place in self.data.items() if name in there]

    @staticmethod
    def colour(place: int) -> int:
        """The number of a colour of the style sheet, from 1."""
        return place % COLOURS + 1

    @staticmethod
    def dash(place: int) -> str:
        """The dash of a place."""
        return DASHES[place % len(DASHES)]


def _places(first: Iterable[str], then: Iterable[str]) -> dict[str, int]:
    return {name: place for place, name in enumerate(dict.fromkeys([*first, *sorted(set(then))]))}


def _calibration(runs: Sequence[RunData], key: str, colours: Colours) -> Chart | None:
    shown = [run for run in runs if key in run.charts]
    if not shown:
        return None
    traces = [
        _of_run(
            trace, run, run.data, colours.colour(colours.data[run.data]), colours.dash(colours.data[run.data])
        )
        for run in shown
        for trace in _with_role(run.charts[key], "before")
    ]
    first = shown[0].charts[key]
    diagonals = [trace["x"] for run in shown for trace in _with_role(run.charts[key], "identity")]
    ends = min(x[0] for x in diagonals), max(x[1] for x in diagonals)
    traces.insert(0, identity(*ends, "calibrated"))
    label = f"{first.title}, {len(shown)} runs, coloured by data set; a calibrated one lies on the diagonal."
    return Chart(first.title, f"{label} {_medians(shown, key)}", traces, square(first.layout, *ends))


def _medians(shown: Sequence[RunData], key: str) -> str:
    """How far each data set's runs are from the diagonal."""
    ratios: dict[str, list[float]] = {}
    for run in shown:
        for trace in _with_role(run.charts[key], "before"):
            pairs = [
                (x, y) for x, y in zip(trace["x"], trace["y"], strict=True) if x and y and x > 0 and y > 0
            ]
            ratios.setdefault(run.data, []).extend(math.log(y / x) for x, y in pairs)
    means = {data: math.exp(sum(values) / len(values)) for data, values in ratios.items() if values}
    return (
        "Vertical over horizontal, geometric mean: "
        + ", ".join(f"{data} {v:.2g}" for data, v in means.items())
        + "."
    )


def _precision(runs: Sequence[RunData], key: str, colours: Colours) -> Chart | None:
    shown = [run for run in runs if f"learning_{key}" in run.charts]
    traces = [
        _of_run(trace, run, f"{run.data}, {role}", colours.colour(colours.data[run.data]), dash)
        for run in shown
        for role, dash in (("test", "solid"), ("train", "dot"))
        for trace in _with_role(run.charts[f"learning_{key}"], role)
    ]
    metric = METRICS[key]
    label = (
        f"{metric.label} over the epochs, solid: test split, dotted: training split. {_ends(traces, metric)}"
    )
    return _over_epochs(metric, metric.label, label, traces)


def _learning(runs: Sequence[RunData], key: str, colours: Colours) -> Chart | None:
    shown = [run for run in runs if f"learning_{key}" in run.charts]
    traces = [
        _of_run(
            trace,
            run,
            f"{run.model}, {run.data}",
            colours.colour(colours.models[run.model]),
            colours.dash(colours.data[run.data]),
        )
        for run in shown
        for trace in _with_role(run.charts[f"learning_{key}"], "test")
    ]
    metric = METRICS[key]
    label = f"{metric.label} on the test split over the epochs, one line a run. {_ends(traces, metric)}"
    return _over_epochs(metric, f"{metric.label}, test split", label, traces)


def _over_epochs(metric: Quantity, title: str, label: str, traces: list[Trace]) -> Chart | None:
    if not traces:
        return None
    log = metric.best is not None or metric.label.startswith("Mean")
    return Chart(title, label, traces, {"xaxis": axis("epochs of training"), "yaxis": axis(metric.axis, log)})


def _ends(traces: Iterable[Trace], metric: Quantity) -> str:
    """Where the lines of each legend entry end, in words."""
    ends: dict[str, list[float]] = {}
    for trace in traces:
        known = [y for y in trace["y"] if y is not None]
        ends.setdefault(trace["legendgroup"], []).extend(known[-1:])
    means = {name: sum(values) / len(values) for name, values in ends.items() if values}
    return "At the end: " + ", ".join(f"{name} {metric.text(value)}" for name, value in means.items()) + "."


def _with_role(chart: Chart, role: str) -> list[Trace]:
    return [trace for trace in chart.data if trace["meta"]["role"] == role]


def _of_run(trace: Trace, run: RunData, group: str, colour: int, dash: str) -> Trace:
    """A run's line among those of others: without its band, in the legend once for all runs alike."""
    meta: dict[str, Any] = {"role": trace["meta"]["role"], "preset": run.preset, "data": run.data}
    return {
        **trace,
        "name": group,
        "legendgroup": group,
        "text": f"{run.preset} / {run.data} / {run.model} / {run.run}",
        "line": {"color": f"var(--series-{colour})", "dash": dash, "width": 1.75},
        "meta": meta,
    }

"""Charts of all runs together, from the charts of each. The script gives the first runs a colour and a label."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

from phd_exp.records.searches import Search
from phd_exp.reports.charts import Chart, Trace, axis, bar_chart, bars, chart, identity, line, square
from phd_exp.reports.runs import Run

CALIBRATION = ("depth_calibration", "projected_calibration", "coverage", "depth_pit")
LEARNING = tuple(
    f"learning_{key}"
    for key in ("projected_error_mm", "depth_error_mm", "nll", "depth_precision", "projected_precision")
)


@dataclass(frozen=True)
class Drawn:
    """A run and its charts by section."""

    run: Run
    charts: dict[str, dict[str, Chart]]


Groups = dict[str, tuple[dict[str, Chart], list[Drawn]]]
"""Name -> charts that share a legend, and the runs of that legend."""


def presets_of(runs: Sequence[Run]) -> list[str]:
    """The presets, those with most finished runs first; `smoke`, whose networks are too small to learn, is last."""
    finished = Counter(run.preset for run in runs if run.state == "finished")
    names = {run.preset for run in runs}
    return sorted(names, key=lambda name: (name.partition("+")[0] == "smoke", -finished[name], name))


def overview_groups(runs: Sequence[Drawn], searches: Sequence[Search] = ()) -> Groups:
    """Calibration and learning curves with a line per run, and the charts of searches, without empty groups."""
    order = presets_of([one.run for one in runs])
    runs = sorted(runs, key=lambda one: order.index(one.run.preset))
    found: Groups = {}
    for name, role, keys in (("calibration", "before", CALIBRATION), ("learning", "test", LEARNING)):
        charts = {f"{name}_{key}": chart for key in keys if (chart := _overlaid(runs, name, key, role))}
        if charts:
            found[name] = charts, [one for one in runs if set(keys) & one.charts.get(name, {}).keys()]
    if charts := {key: chart for search in searches for key, chart in search_charts(search).items()}:
        found["search"] = charts, []
    return found


def _overlaid(runs: Sequence[Drawn], section: str, key: str, role: str) -> Chart | None:
    shown = [(one, one.charts[section][key]) for one in runs if key in one.charts.get(section, {})]
    traces = [_of_run(trace, one) for one, chart in shown for trace in _with_role(chart, role)]
    if not traces:
        return None
    layout = shown[0][1].layout
    diagonals = [trace["x"] for _, chart in shown for trace in _with_role(chart, "identity")]
    if diagonals:
        ends = min(x[0] for x in diagonals), max(x[1] for x in diagonals)
        traces.insert(0, identity(*ends, "calibrated"))
        layout = square(layout, *ends)
    made = chart(shown[0][1].title, traces, layout["xaxis"], layout["yaxis"])
    return replace(made, label=f"{made.label} {len(shown)} runs.")


def _with_role(chart: Chart, role: str) -> list[Trace]:
    return [trace for trace in chart.data if trace["meta"]["role"] == role]


def _of_run(trace: Trace, one: Drawn) -> Trace:
    """The line of a run in a chart of all runs, without its band."""
    return {
        **trace,
        "name": one.run.path,
        "text": one.run.path,
        "meta": {"role": trace["meta"]["role"], "preset": one.run.preset, "data": one.run.data},
    }


def search_charts(search: Search) -> dict[str, Chart]:
    """The values of all trials with the best so far, and the importances of the keys."""
    if not search.finished:
        return {}
    values = [value for value, _ in search.finished]
    numbers = [trial.number + 1 for _, trial in search.finished]
    so_far = [min(values[: place + 1]) for place in range(len(values))]
    points = line("finished trials", numbers, values, 1) | {"mode": "markers"}
    best = line("best so far", numbers, so_far, 2)
    history = chart(f"{search.name}: history", [points, best], axis("trial"), axis(search.objective))
    charts = {f"history_{search.name}": history}
    if ranked := sorted(search.importances.items(), key=lambda item: -item[1]):
        keys, shares = zip(*ranked, strict=True)
        x = axis("share of the variance of the score", rangemode="tozero")
        trace = bars("importance", shares, keys, 1, shares, shares)
        charts[f"importance_{search.name}"] = bar_chart(f"{search.name}: importance of keys", trace, x, "")
    return charts

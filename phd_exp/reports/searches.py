"""Searches: a table of the best trials of each, the history of its trials, and the importance of its keys."""

from phd_exp.records.errors import one_line
from phd_exp.records.searches import Search, Trial
from phd_exp.reports.runs import Report
from phd_exp.reports.site.charts import Chart, axis, bars, line
from phd_exp.reports.table import Table, TableCell, TableRow, file_stem, printable

MOST = 10  # trials of a table
OF_A_SEARCH = (
    "Searches minimise a score on held-out samples, which are never trained on; test samples choose nothing. In the "
    "CSV file, the value of a pruned trial is that of its last epoch."
)


def search_tables(report: Report) -> list[Table]:
    """The best trials of every search."""
    return [_table(search) for search in report.searches]


def _table(search: Search) -> Table:
    cells = {id(trial): _cell(search, trial) for trial in search.trials}
    best = [trial for _, trial in sorted(search.finished, key=lambda found: found[0])[:MOST]]
    counts = ", ".join(
        f"{n} {state}"
        for state in ("finished", "pruned", "failed", "running")
        if (n := sum(trial.state == state for trial in search.trials))
    )
    return Table(
        stem=file_stem("search", search.name),
        kind="searches",
        title=one_line(f"Search {search.name}: {counts}"),
        stub=("trial", "overrides"),
        columns=(one_line(search.objective),),
        groups=(tuple(TableRow((str(one.number + 1), one_line(_words(one))), (cells[id(one)],)) for one in best),),
        notes=(OF_A_SEARCH,),
        cells=tuple(cells.values()),
    )


def _cell(search: Search, trial: Trial) -> TableCell:
    line = {"search": search.name, "trial": trial.number + 1, "state": trial.state, "value": trial.value}
    line |= {"overrides": _words(trial), "run": printable(trial.run)}
    return TableCell("" if trial.value is None else f"{trial.value:.4g}", numbers=(line,))


def _words(trial: Trial) -> str:
    """The overrides of a trial, with numbers short enough to read."""
    return " ".join(f"{key}={_short(value)}" for key, value in trial.overrides.items())


def _short(text: str) -> str:
    try:
        return f"{float(text):.4g}"
    except ValueError:
        return text


def search_charts(search: Search) -> dict[str, Chart]:
    """The values of all trials with the best so far, and the importances of the keys."""
    if not search.finished:
        return {}
    values = [value for value, _ in search.finished]
    numbers = [trial.number + 1 for _, trial in search.finished]
    so_far = [min(values[: place + 1]) for place in range(len(values))]
    points = line("finished trials", numbers, values, 1) | {"mode": "markers"}
    label = f"{search.objective} of {len(values)} finished trials; the best is {min(values):.4g}."
    layout = {"xaxis": axis("trial"), "yaxis": axis(search.objective)}
    history = Chart(f"{search.name}: history", label, [points, line("best so far", numbers, so_far, 2)], layout)
    charts = {f"history_{search.name}": history}
    if ranked := sorted(search.importances.items(), key=lambda item: -item[1]):
        keys, shares = zip(*ranked, strict=True)
        label = ", ".join(f"{key} {share:.0%}" for key, share in ranked)
        layout = {
            "xaxis": axis("share of the variance of the score", rangemode="tozero"),
            "yaxis": axis("") | {"type": "category", "autorange": "reversed"},
        }
        trace = bars("importance", shares, keys, 1, shares, shares)
        charts[f"importance_{search.name}"] = Chart(f"{search.name}: importance of keys", label, [trace], layout)
    return charts

"""Searches: a table of the best trials of each."""

from phd_exp.records.searches import Search, Trial
from phd_exp.reports.runs import Report
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
        title=f"Search {search.name}: {counts}",
        stub=("trial", "overrides"),
        columns=(search.objective,),
        groups=(tuple(TableRow((str(one.number + 1), _words(one)), (cells[id(one)],)) for one in best),),
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

"""Makes the report of each run and each search alone first, so that a record that breaks it does not break all."""

import io
import json
from contextlib import redirect_stdout
from dataclasses import asdict, replace
from functools import partial

from phd_exp.records.searches import Search
from phd_exp.reports.files import all_tables, run_lines, tidy
from phd_exp.reports.measured import Notes
from phd_exp.reports.runs import Report, Run, unreadable
from phd_exp.reports.site.overview import search_charts
from phd_exp.reports.terminal import print_report


def rehearsed(report: Report) -> Report:
    """The report without what breaks it: such a run counts as unreadable, such a search is left out with a note."""
    runs = tuple(_shown(report, run) for run in report.runs)
    searches = tuple(search for search in report.searches if _is_shown(report, search))
    return replace(report, runs=runs, searches=searches)


def _shown(report: Report, run: Run) -> Run:
    notes = Notes()
    notes.attempt(partial(_show, replace(report, runs=(run,), searches=(), notes=notes)))
    return unreadable(run.folder, notes) if notes else run


def _is_shown(report: Report, search: Search) -> bool:
    notes = Notes()
    notes.attempt(partial(_show, replace(report, runs=(), searches=(search,), notes=notes)))
    report.notes.extend(f"search {search.name} is left out: {note}" for note in notes)
    return not notes


def _show(report: Report) -> None:
    """Make all tables, the list of runs and the charts of searches, everything except pages; discard them."""
    tables = all_tables(report)
    with redirect_stdout(io.StringIO()):
        print_report(report, tables)
    tidy([*run_lines(report)])
    for search in report.searches:
        json.dumps([asdict(chart) for chart in search_charts(search).values()])

"""`python -m phd_exp report`: tables, figures and pages of all recorded runs."""

import sys
from importlib.util import find_spec
from pathlib import Path

from phd_exp.cli.arguments import Arguments
from phd_exp.records.errors import UserError, writing
from phd_exp.records.processes import announce
from phd_exp.records.written import Written


class ReportArguments(Arguments):
    """The folder of the runs and the folder of the report."""

    runs: Path = Path("runs")
    """the folder of the runs"""
    out: Path = Path("report")
    """the folder to write to"""


def main(words: list[str]) -> int:
    """Print and write the report; returns the exit status."""
    folders = ReportArguments.parsed("report", words)
    if not folders.runs.is_dir():
        raise UserError(f"{folders.runs}: no such folder; train first, or name another by runs=DIR")
    if not all(map(find_spec, ("pandas", "matplotlib", "plotly", "jinja2"))):
        raise UserError("report: needs `pip install 'phd_exp[report]'`")
    from phd_exp.hardware import one_thread  # imports torch

    # tables of a few thousand rows are too small for several threads
    with writing(folders.out, "out=DIR", UserError), one_thread():
        Written(folders.out, "measured").require("measured.parquet", "measured.csv")
        Written(folders.out / "site", "report").require("index.html", "compare.html")
        _report(folders.runs, folders.out)
    return 0


def _report(runs: Path, out: Path) -> None:
    # imports of seconds, which follow the check of the arguments
    from phd_exp.reports.files import all_tables, write_tables
    from phd_exp.reports.paper_figures import write_figures
    from phd_exp.reports.report import read_report
    from phd_exp.reports.site.build import write_site
    from phd_exp.reports.terminal import print_report

    # on a terminal, one line names the run being measured
    line = "\r\x1b[Kmeasuring {}\r" if sys.stderr.isatty() else ""
    report = read_report(
        runs, out / "measured", lambda run: print(line.format(run), end="", file=sys.stderr, flush=True)
    )
    tables = all_tables(report)
    print_report(report, tables)
    if report.runs:
        print(f"tables: {write_tables(report, tables, out)}", flush=True)
        figures = write_figures(report, out / "figures")
        print(f"figures: {out / 'figures'}", flush=True)
        print(f"site: {write_site(report, tables, figures, out / 'site')}, to be opened in a browser")
    for note in report.notes:
        announce(f"note: {note}")

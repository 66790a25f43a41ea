"""`python -m phd_exp report`: every recorded run, read once; tables in the terminal and as files, figures, pages."""

import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

from phd_exp.cli.arguments import Arguments, parsed
from phd_exp.records.errors import UserError

FOR_PICTURES = ("matplotlib", "plotly", "jinja2")


class ReportArguments(Arguments):
    """Where the runs are and where the report goes."""

    runs: Path = Path("runs")
    out: Path = Path("report")


def main(words: list[str]) -> int:
    """Print and write the tables, figures and pages; returns the exit status."""
    folders = parsed("report", ReportArguments, words)
    if not folders.runs.is_dir():
        raise UserError(f"{folders.runs}: no such folder; train first, or name another by runs=DIR")
    try:
        _report(folders.runs, folders.out)
    except OSError as error:
        raise UserError(
            f"{error.filename or folders.out}: cannot be written ({error.strerror}); choose another folder by out=DIR"
        ) from None
    return 0


def _report(runs: Path, out: Path) -> None:
    # seconds of imports, torch among them, which a mistake in the command need not wait for
    from phd_exp.reports.files import all_tables, write_tables
    from phd_exp.reports.runs import read_report
    from phd_exp.reports.terminal import print_report
    from phd_exp.threads import one_thread

    with one_thread():  # tables of a few thousand rows are too small to share
        report = read_report(runs, out / "measured", _progress())
        tables = all_tables(report)
        print_report(report, tables)
        if not report.runs:
            return
        if tables:
            print(f"tables: {write_tables(tables, out)}")
        if not all(map(find_spec, FOR_PICTURES)):
            print("figures and site were not made: they need `pip install 'phd_exp[report]'`")
            return
        from phd_exp.reports.paper_figures import write_figures
        from phd_exp.reports.site.build import write_site

        figures = write_figures(report, out / "figures")
        print(f"figures: {out / 'figures'}")
        print(f"site: {write_site(report, tables, figures, out / 'site')}, to be opened in a browser")


def _progress() -> Callable[[str], None]:
    """On a terminal, one line that says which run is being measured."""
    if not sys.stderr.isatty():
        return lambda run: None
    return lambda run: print(f"\r\x1b[Kmeasuring {run}", end="\r", file=sys.stderr, flush=True)

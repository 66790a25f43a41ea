"""`python -m phd_exp report`: the paper's tables from all recorded runs, printed and written, and their site."""

from importlib.util import find_spec
from pathlib import Path

from phd_exp.cli.arguments import Arguments, parsed
from phd_exp.records.errors import UserError
from phd_exp.reports.collect import Records, collect
from phd_exp.reports.formats.files import write_fusion_tables, write_tables, write_variation_tables
from phd_exp.reports.formats.terminal import print_complaints, print_report, print_tables
from phd_exp.reports.tables import tables
from phd_exp.reports.variations import variation_tables

FOR_THE_SITE = ("matplotlib", "plotly", "jinja2")


class ReportArguments(Arguments):
    """Where the runs are and where the report goes."""

    runs: Path = Path("runs")
    out: Path = Path("report")


def main(words: list[str]) -> int:
    """Print and write the tables and build the site; returns the exit status."""
    folders = parsed("report", ReportArguments, words)
    if not folders.runs.is_dir():
        raise UserError(f"{folders.runs}: no such folder; train first, or name another by runs=DIR")
    records = collect(folders.runs)
    drawn = tables(records)
    print_report(records, drawn)
    if drawn:
        print(f"tables: {write_tables(drawn, folders.out)}")
    if varied := variation_tables(records):
        print_tables(varied)
        print(f"tables of variations: {write_variation_tables(varied, folders.out)}")
    if any(run.folder.views.exists() for run in records.runs):
        _fusion(records, folders.out)
    if records.runs:
        _build_site(folders.runs, folders.out)
    return 0


def _fusion(records: Records, out: Path) -> None:
    # torch, which a report on single views gets its tables without
    from phd_exp.reports.fusion_table import fusion_tables

    drawn, complaints = fusion_tables(records)
    print_tables(drawn)
    print_complaints(complaints)
    if drawn:
        print(f"tables of fusion: {write_fusion_tables(drawn, out)}")


def _build_site(runs: Path, out: Path) -> None:
    if not all(map(find_spec, FOR_THE_SITE)):
        print("the site was not built: that needs `pip install 'phd_exp[report]'`")
        return
    # seconds of imports, torch among them, which the tables need not wait for
    from phd_exp.reports.site.build import build_site

    print(f"site: {build_site(runs, out)}, to be opened in a browser")
    print(f"figures: {out / 'figures'}")

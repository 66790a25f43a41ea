"""`python -m phd_exp report`: the paper's tables from all recorded runs, printed and written."""

import sys

from phd_exp.cli.folders import named_folders, require_folder
from phd_exp.records.errors import UserError
from phd_exp.reports.collect import collect
from phd_exp.reports.formats.files import write_tables
from phd_exp.reports.formats.terminal import print_report
from phd_exp.reports.tables import tables

FOLDERS = {"runs": "runs", "out": "report"}


def main(arguments: list[str]) -> int:
    try:
        folders = named_folders("report", FOLDERS, arguments)
        require_folder("runs", folders["runs"], "train first, or say where the runs are")
        records = collect(folders["runs"])
        drawn = tables(records)
        print_report(records, drawn)
        if drawn:
            print(f"tables: {write_tables(drawn, folders['out'])}")
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0

"""`python -m phd_exp report`: the table of all recorded runs beside the paper's numbers."""

import sys

from phd_exp.cli.folders import named_folder
from phd_exp.records.errors import UserError
from phd_exp.reports.collect import collect
from phd_exp.reports.tables import print_table


def main(arguments: list[str]) -> int:
    try:
        advice = "train first, or say where the runs are"
        print_table(collect(named_folder("report", "runs", "runs", arguments, if_missing=advice)))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0

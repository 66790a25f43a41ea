"""`python -m phd_exp report`: the table of all recorded runs beside the paper's numbers."""

import sys
from pathlib import Path

from phd_exp.records.errors import UserError
from phd_exp.reports.collect import collect
from phd_exp.reports.tables import print_table


def main(arguments: list[str]) -> int:
    try:
        print_table(collect(runs_folder(arguments)))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def runs_folder(arguments: list[str]) -> Path:
    """The folder named by `runs=DIR`, or `runs`. Raises UserError for anything else."""
    folder = Path("runs")
    for argument in arguments:
        key, _, value = argument.partition("=")
        if key != "runs" or not value:
            raise UserError(f"{argument}: report takes runs=DIR and nothing else")
        folder = Path(value)
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; train first, or say where the runs are by runs=DIR")
    return folder

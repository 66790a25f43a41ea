"""Tables on disk, each file written whole."""

import csv
import io
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from phd_exp.records.files import remove_temporaries
from phd_exp.reports.calibration_table import calibration_tables
from phd_exp.reports.formats.latex import latex
from phd_exp.reports.formats.markdown import markdown
from phd_exp.reports.fusion_table import fusion_tables
from phd_exp.reports.paper_tables import paper_tables
from phd_exp.reports.runs import Report
from phd_exp.reports.table import Table, write_text
from phd_exp.reports.variations import variation_tables


def all_tables(report: Report) -> list[Table]:
    """The paper's tables, then calibration, variations and fusion of the runs that have them."""
    return [
        *paper_tables(report),
        *calibration_tables(report),
        *variation_tables(report),
        *fusion_tables(report),
    ]


def write_tables(tables: Sequence[Table], out: Path) -> Path:
    """Write `<out>/tables/<stem>.{md,tex}` of each table and `<kind>.csv` of each kind; returns that folder."""
    folder = out / "tables"
    folder.mkdir(parents=True, exist_ok=True)
    remove_temporaries(folder)  # of a process that was killed
    for table in tables:
        write_text(folder / f"{table.stem}.md", markdown(table))
        write_text(folder / f"{table.stem}.tex", latex(table))
    for kind, alike in groupby(tables, key=lambda table: table.kind):
        write_text(folder / f"{kind}.csv", tidy([line for table in alike for line in table.numbers]))
    return folder


def tidy(numbers: Sequence[Mapping[str, Any]]) -> str:
    """A line a number, at full precision; what does not exist is empty."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, list(numbers[0]) if numbers else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(numbers)
    return stream.getvalue()

"""Tables as CSV: a line a number, for pandas and spreadsheets."""

import csv
import io
from collections.abc import Iterable, Mapping
from typing import Any

from phd_exp.reports.cells import Cell
from phd_exp.reports.tables import PaperTable

COLUMNS = (
    "preset",
    "table",
    "data",
    "model",
    "estimate",
    "reading",
    "quantity",
    "n_seeds",
    "mean",
    "low",
    "high",
    "interval",
    "published",
    "ratio",
    "floor",
    "best",
    "n_test",
    "state",
)
"""Millimetres from `mean` to `high`, `published` and `floor`; what there is not, is empty."""


def tidy(tables: Iterable[PaperTable]) -> str:
    """A line for every number of every table, measured or missing, at full precision."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, COLUMNS, lineterminator="\n")
    writer.writeheader()
    for table in tables:
        for row in table.rows:
            for place in row.cells:
                if place.source is not None:
                    writer.writerow(_line(place.source, table.name, place.bold))
    return stream.getvalue()


def _line(cell: Cell, table: str, best: bool) -> Mapping[str, Any]:
    interval = cell.interval
    return {
        "preset": cell.preset,
        "table": table,
        "data": cell.data,
        "model": cell.model,
        "estimate": cell.key.estimate,
        "reading": cell.key.reading,
        "quantity": f"{cell.key.quantity}_error_mm",
        "n_seeds": len(cell.seeds),
        "mean": cell.mean,
        "low": interval.low if interval else None,
        "high": interval.high if interval else None,
        "interval": interval.kind if interval else "none",
        "published": cell.published,
        "ratio": cell.ratio,
        "floor": cell.floor,
        "best": best,
        # of runs that were tested on different numbers of samples, the least
        "n_test": min(cell.n_test, default=0),
        "state": cell.state,
    }

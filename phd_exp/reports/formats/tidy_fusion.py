"""What fusion gives as CSV: a line a number, at full precision."""

import csv
import io
from collections.abc import Iterable

from phd_exp.reports.fusion_table import FusionTable

COLUMNS = (
    *("preset", "data", "model", "run", "quantity", "method", "cameras", "ground"),
    *("mean", "low", "high", "n_scenes"),
)
"""Errors in millimetres, coverage in per cent; `low` to `high` is a 95 % bootstrap interval over scenes."""


def tidy_fusion(tables: Iterable[FusionTable]) -> str:
    """A line for every number of every table."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    for table in tables:
        run = table.run
        named = (run.preset, run.data, run.model, run.folder.path.name)
        for place, band in table.scores.bands.items():
            what = (place.quantity, place.method, place.cameras, place.on_plane)
            writer.writerow((*named, *what, band.value, band.low, band.high, table.scores.n))
    return stream.getvalue()

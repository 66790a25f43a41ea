"""All that is known of one run, read once, whatever state its record is in."""

import hashlib
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

import pyarrow as pa

from phd_exp.evaluation.fusion import FusionScores, fusion_scores
from phd_exp.evaluation.parquet import read_table
from phd_exp.evaluation.several_views import read_views
from phd_exp.records.choices import flatten
from phd_exp.records.errors import RunError, UserError
from phd_exp.records.runs import RunFolder, RunStatus
from phd_exp.reports.collect import Run
from phd_exp.reports.site.assessment import Assessment, assess

Found = TypeVar("Found")

EPOCH = "epoch"


@dataclass(frozen=True)
class Dossier:
    """One run. What could not be read is None or empty, and `notes` says why, a line each.

    Attributes:
        run: its choices and its state.
        metrics: a series a key of metrics.jsonl, all as long as `epochs`; None where a row lacks the key.
        epochs: epochs trained before each row; 0 is the untrained network.
        config: every value of config.yaml as text, by its dotted path.
        predictions: the table of predictions.parquet.
        fusion: what several cameras see together, of a run that was tried on that.
    """

    run: Run
    status: RunStatus | None
    config: Mapping[str, str]
    epochs: list[int]
    metrics: Mapping[str, list[float | None]]
    predictions: pa.Table | None
    assessment: Assessment | None
    fusion: FusionScores | None = None
    notes: list[str] = field(default_factory=list)


def read_dossier(run: Run) -> Dossier:
    """Read everything of a run that is there; never fails on what a run left behind."""
    notes: list[str] = []
    folder = run.folder
    rows = _attempt(folder.metrics, notes) or []
    predictions = None
    if folder.predictions.exists():
        predictions = _attempt(lambda: read_predictions(folder), notes)
    assessment = None if predictions is None else _attempt(lambda: assess(folder, predictions), notes)
    if assessment and assessment.before.left_out:
        notes.append(f"{assessment.before.left_out} test samples are left out: a prediction was not finite")
    fusion = None
    if folder.views.exists():
        fusion = _attempt(lambda: fusion_scores(read_views(folder.views)), notes)
    return Dossier(
        run=run,
        status=_attempt(folder.status, notes),
        config=_attempt(lambda: read_config(folder), notes) or {},
        epochs=[row[EPOCH] + 1 for row in rows],
        metrics=_series(rows),
        predictions=predictions,
        assessment=assessment,
        fusion=fusion,
        notes=list(dict.fromkeys(notes)),
    )


def read_config(folder: RunFolder) -> dict[str, str]:
    """Every value of a run's configuration as text, by its dotted path. Raises RunError where it cannot be read."""
    return {key: "" if value is None else str(value) for key, value in flatten(folder.config()).items()}


def slug_of(run: Run) -> str:
    """A file name that differs wherever runs differ, whatever characters their names hold."""
    names = (run.preset, run.data, run.model, run.folder.path.name)
    plain = "-".join(re.sub(r"[^A-Za-z0-9_-]+", "-", name) for name in names)
    # a hyphen in any name but the last could be taken for one that joins them
    unmistakable = plain == "-".join(names) and not any("-" in name for name in names[:3])
    return (
        plain if unmistakable else f"{plain[:100]}-{hashlib.sha256('/'.join(names).encode()).hexdigest()[:8]}"
    )


def _attempt(read: Callable[[], Found], notes: list[str]) -> Found | None:
    try:
        return read()
    except (UserError, OSError, ValueError) as error:  # the last from measures, of what cannot be measured
        notes.append(" ".join(str(error).split()))
        return None


def read_predictions(folder: RunFolder) -> pa.Table:
    """The table of a run's predictions. Raises RunError where it cannot be read or is empty."""
    file = folder.predictions
    table = read_table(file)
    if table.num_rows == 0:
        raise RunError(f"{file}: holds no predictions; delete the folder to run again")
    return table


def _series(rows: list[dict[str, Any]]) -> dict[str, list[float | None]]:
    keys = sorted({key for row in rows for key in row} - {EPOCH, "step"})
    return {key: [_number(row.get(key)) for row in rows] for key in keys}


def _number(value: Any) -> float | None:
    try:
        number = float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
    except OverflowError:  # JSON knows whole numbers without end
        return None
    return number if math.isfinite(number) else None

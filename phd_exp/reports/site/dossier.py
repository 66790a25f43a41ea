"""All that is known of one run, read once, whatever state its record is in."""

import hashlib
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import pyarrow as pa
import pyarrow.parquet as pq

from phd_exp.records.errors import RunError, UserError
from phd_exp.records.runs import RunFolder, RunStatus
from phd_exp.reports.site.assessment import Assessment, assess

Found = TypeVar("Found")

EPOCHS = "epoch"


@dataclass(frozen=True)
class RunIdentity:
    """The four names of a run's folder, and the one that stands for them in addresses."""

    preset: str
    data: str
    model: str
    run: str

    @classmethod
    def of(cls, folder: RunFolder, runs: Path) -> "RunIdentity":
        return cls(*folder.path.relative_to(runs).parts)

    @property
    def title(self) -> str:
        return f"{self.model} on {self.data}"

    @property
    def slug(self) -> str:
        """A file name that differs wherever the names differ, whatever characters they hold."""
        whole = "/".join((self.preset, self.data, self.model, self.run))
        plain = re.sub(r"[^A-Za-z0-9_-]+", "-", whole)
        return plain if plain == whole.replace("/", "-") and "-" not in self._apart else f"{plain}-{_digest(whole)}"

    @property
    def _apart(self) -> str:
        """The names whose hyphens could be taken for the slug's own; a run's name comes last and cannot."""
        return self.preset + self.data + self.model


@dataclass(frozen=True)
class Dossier:
    """One run. What could not be read is None or empty, and `notes` says why, a line each.

    Attributes:
        state: running, broken off, finished, failed, interrupted or unreadable.
        metrics: a series a key of metrics.jsonl, all as long as `epochs`; None where a row lacks the key.
        epochs: epochs trained before each row; 0 is the untrained network.
        predictions: the table of predictions.parquet.
    """

    identity: RunIdentity
    path: Path
    state: str
    status: RunStatus | None
    config: Mapping[str, Any]
    epochs: list[int]
    metrics: Mapping[str, list[float | None]]
    predictions: pa.Table | None
    assessment: Assessment | None
    notes: list[str] = field(default_factory=list)


def read_dossier(folder: RunFolder, runs: Path) -> Dossier:
    """Read everything of a run that is there; never fails on what a run left behind."""
    notes: list[str] = []
    status = _attempt(folder.status, notes)
    state = _state(folder, status)
    rows = _attempt(folder.metrics, notes) or []
    predictions = None
    if folder.predictions.exists():
        predictions = _attempt(lambda: _table(folder.predictions), notes)
    elif state == "finished":
        notes.append(f"{folder.predictions}: missing; delete the folder to run again")
    assessment = None if predictions is None else _attempt(lambda: assess(folder, predictions), notes)
    return Dossier(
        identity=RunIdentity.of(folder, runs),
        path=folder.path,
        state=state,
        status=status,
        config=_attempt(folder.config, notes) or {},
        epochs=[row[EPOCHS] + 1 for row in _sound(rows)],
        metrics=_series(_sound(rows)),
        predictions=predictions,
        assessment=assessment,
        notes=notes,
    )


def _attempt(read: Callable[[], Found], notes: list[str]) -> Found | None:
    try:
        return read()
    except (UserError, OSError) as error:
        notes.append(" ".join(str(error).split()))
        return None


def _state(folder: RunFolder, status: RunStatus | None) -> str:
    if status is None:
        return "unreadable"
    if status.state == "running" and not folder.is_held():
        return "broken off"
    return status.state


def _table(file: Path) -> pa.Table:
    try:
        table = pq.read_table(file)
    except (pa.ArrowException, OSError) as error:
        reason = " ".join(str(error).split())[:200]
        raise RunError(f"{file}: cannot be read ({reason}); delete the folder to run again") from None
    if table.num_rows == 0:
        raise RunError(f"{file}: holds no predictions; delete the folder to run again")
    return table


def _sound(rows: list[Any]) -> list[dict[str, Any]]:
    return [row for row in rows if isinstance(row, dict) and type(row.get(EPOCHS)) is int]


def _series(rows: list[dict[str, Any]]) -> dict[str, list[float | None]]:
    keys = sorted({key for row in rows for key in row} - {EPOCHS, "step"})
    return {key: [_number(row.get(key)) for row in rows] for key in keys}


def _number(value: Any) -> float | None:
    sound = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if sound else None


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:8]

"""Reads and measures every recorded run, each inside one boundary: a broken record costs its own page a line."""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from phd_exp.evaluation.parquet import read_table
from phd_exp.evaluation.point_errors import COLUMNS, Estimate, MeanErrors, mean_errors
from phd_exp.records.choices import flatten, has_influence
from phd_exp.records.errors import one_line
from phd_exp.records.files import remove_temporaries
from phd_exp.records.runs import RunFolder, RunStatus, find_runs
from phd_exp.reports.measured import Measured, Notes, kept_or_measured
from phd_exp.reports.table import file_stem, printable

RunState = Literal["finished", "running", "interrupted", "failed", "unreadable"]
PROBABILISTIC = "probabilistic"
LEAF = re.compile(r"seed(0|[1-9][0-9]{0,8})(-[0-9a-f]{8})?")


@dataclass(frozen=True)
class Run:
    """One run. What could not be read is None or empty, and `notes` say why.

    Attributes:
        preset, data, model, name: of its folder, printable.
        seed: None where the folder's name is none that a run is given.
        overrides: None of a run at its preset's values; else how it differs.
        detail: one line on a state other than finished.
        errors, nll: of a finished run; NLL in nats, None for a model without a density.
        held_out_errors, held_out_nll: the same on its held-out samples.
        config: every value as text, by its dotted key.
        epochs: epochs trained before each row of `metrics`; 0 is the untrained network.
        metrics: a series a key, None where a row lacks it.
    """

    folder: RunFolder
    preset: str
    data: str
    model: str
    name: str
    seed: int | None = None
    state: RunState = "unreadable"
    overrides: str | None = None
    detail: str = ""
    status: RunStatus | None = None
    errors: MeanErrors = field(default_factory=dict)
    nll: float | None = None
    held_out_errors: MeanErrors = field(default_factory=dict)
    held_out_nll: float | None = None
    config: Mapping[str, str] = field(default_factory=dict)
    epochs: Sequence[int] = ()
    metrics: Mapping[str, list[float | None]] = field(default_factory=dict)
    measured: Measured = field(default_factory=Measured)
    notes: Sequence[str] = ()

    @property
    def title(self) -> str:
        """Model and data set."""
        return f"{self.model} on {self.data}"

    @property
    def path(self) -> str:
        """All its names."""
        return f"{self.preset}/{self.data}/{self.model}/{self.name}"

    @property
    def slug(self) -> str:
        """Its name as a file name."""
        return file_stem(*self.folder.path.parts[-4:])


@dataclass(frozen=True)
class Report:
    """All runs under a folder, by their paths: read once, and drawn from by the terminal, the files and the pages."""

    folder: Path
    runs: tuple[Run, ...]

    @property
    def presets(self) -> list[str]:
        """All presets, with their recipes, in order."""
        return sorted({run.preset for run in self.runs})

    def at_defaults(self, preset: str, data: str, model: str) -> dict[int, Run]:
        """Seed -> run, of the runs that follow their preset in all that changes the law of their results."""
        choice = (preset, data, model)
        # of two runs of a seed the one without a hash, which sorts first, wins
        return {
            run.seed: run
            for run in reversed(self.runs)
            if run.overrides is None and run.seed is not None and (run.preset, run.data, run.model) == choice
        }


def read_report(
    runs: Path, kept: Path | None = None, progress: Callable[[str], None] = lambda run: None
) -> Report:
    """Read and measure every run; measurements are kept in a folder, if any, and reused until the run changes.

    Raises OSError where that folder cannot be written.
    """
    found = []
    folders = find_runs(runs)
    if folders and kept:
        kept.mkdir(parents=True, exist_ok=True)
        remove_temporaries(kept)  # of a process that was killed
    for folder in folders:
        progress("/".join(map(printable, folder.path.parts[-4:])))
        found.append(_read_run(folder, kept))
    return Report(runs, tuple(found))


def _read_run(folder: RunFolder, kept: Path | None) -> Run:
    notes = Notes()
    preset, data, model, name = (printable(part) for part in folder.path.parts[-4:])
    run = notes.attempt(lambda: _whole_run(folder, (preset, data, model, name), kept, notes))
    return run or Run(folder, preset, data, model, name, detail=notes[-1], notes=notes)


def _whole_run(folder: RunFolder, names: tuple[str, str, str, str], kept: Path | None, notes: Notes) -> Run:
    leaf = LEAF.fullmatch(names[3])
    status = notes.attempt(folder.status)
    state, detail = _state(folder, status)
    if status is None and notes:
        detail = notes[-1]
    if leaf is None:
        state, detail = "unreadable", f"{names[3]}: expected a folder named seed<k> or seed<k>-<hash>"
    config = notes.attempt(lambda: _config(folder)) or {}
    rows = notes.attempt(folder.metrics) or []
    estimates: Sequence[Estimate] = tuple(COLUMNS) if names[2] == PROBABILISTIC else ("mode",)
    tested = notes.attempt(lambda: _errors(folder.predictions, estimates)) if state == "finished" else None
    if state == "finished" and tested is None:
        state, detail = "unreadable", f"{notes[-1]}; delete the folder to run again"
    held_out = (
        notes.attempt(lambda: _errors(folder.held_out, ("mode",))) if folder.held_out.exists() else None
    )
    measured = notes.attempt(lambda: kept_or_measured(folder, config, kept)) or Measured()
    return Run(
        folder,
        *names,
        seed=int(leaf[1]) if leaf else None,
        state=state,
        overrides=_overrides(folder) if leaf and leaf[2] else None,
        detail=one_line(detail),
        status=status,
        errors=tested[0] if tested else {},
        nll=tested[1] if tested else None,
        held_out_errors=held_out[0] if held_out else {},
        held_out_nll=held_out[1] if held_out else None,
        config=config,
        epochs=[row["epoch"] + 1 for row in rows],
        metrics=_series(rows),
        measured=measured,
        notes=list(dict.fromkeys([*notes, *measured.notes])),
    )


def _errors(file: Path, estimates: Sequence[Estimate]) -> tuple[MeanErrors, float | None]:
    table = read_table(file)
    return mean_errors(table, estimates), _number(float(table["nll"].mean())) if "nll" in table else None


def _state(folder: RunFolder, status: RunStatus | None) -> tuple[RunState, str]:
    if status is None:
        return "unreadable", "status.json: missing"
    if status.state != "running":
        return status.state, status.error or ""
    try:
        alive = folder.is_held()
    except OSError as error:  # a lock cannot be tried in a folder that is read-only
        return "running", f"or interrupted: its lock cannot be tried ({error.strerror})"
    return ("running", "") if alive else ("interrupted", "the same command resumes it")


def _config(folder: RunFolder) -> dict[str, str]:
    return {key: "" if value is None else str(value) for key, value in flatten(folder.config()).items()}


def _series(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[float | None]]:
    keys = sorted({key for row in rows for key in row} - {"epoch", "step"})
    return {key: [_number(row.get(key)) for row in rows] for key in keys}


def _number(value: Any) -> float | None:
    try:
        number = float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
    except OverflowError:  # JSON knows whole numbers without end
        return None
    return number if math.isfinite(number) else None


def _overrides(folder: RunFolder) -> str | None:
    """How a run differs from one beside it at its preset's values; None where all that matters is equal."""
    for path in sorted(folder.path.parent.glob("seed*")):
        if "-" not in path.name and (plain := Notes().attempt(RunFolder(path).config)) is not None:
            changes = _changes(plain, folder.config())
            return ", ".join(f"{key}={value}" for key, value in changes.items()) or None
    return "unknown: there is no run without overrides to compare with"


def _changes(before: dict[str, Any], now: dict[str, Any]) -> dict[str, Any]:
    """By dotted keys. Of a part made by another class: its name, and what both classes take."""
    old, new = flatten(before), flatten(now)
    changes: dict[str, Any] = {}
    for key in dict.fromkeys([*old, *new]):
        if key == "seed" or not has_influence(key) or old.get(key, "nothing") == new.get(key, "nothing"):
            continue
        part, _, leaf = key.rpartition(".")
        made_by = f"{part}._target_"
        if leaf == "_target_":
            changes[part] = str(new.get(key)).rpartition(".")[2]
        elif old.get(made_by) == new.get(made_by) or (key in old and key in new):
            changes[key] = new.get(key, "nothing")
    return changes

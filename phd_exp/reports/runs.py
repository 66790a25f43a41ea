"""Reads and measures a recorded run inside one boundary: a broken record only affects its own page."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from phd_exp.evaluation.parquet import Arrays, read_table
from phd_exp.evaluation.point_errors import COLUMNS, Estimate, MeanErrors, mean_errors
from phd_exp.records.choices import flatten, has_influence
from phd_exp.records.errors import READABLE, RunError, one_line
from phd_exp.records.runs import AGAIN, SECTIONS, RunFolder, RunStatus, choosing
from phd_exp.reports.measured import Measured, Notes, kept_or_measured, measure
from phd_exp.reports.table import file_stem, printable

RunState = Literal["finished", "running", "interrupted", "failed", "unreadable"]
PROBABILISTIC = "probabilistic"
LEAF = re.compile(r"seed(0|[1-9][0-9]{0,8})(-[0-9a-f]{8})?")


@dataclass(frozen=True)
class Run:
    """One run. Parts that cannot be read are None or empty; `notes` give the reasons.

    Attributes:
        preset, data, model, name: names of its folders, printable.
        seed: None if the name of the folder is not that of a run.
        overrides: words of its command line that change results, or their hash if they are unknown; None without any.
        detail: one line on a state other than finished.
        errors, nll: of a finished run; NLL in nats, None for a model without a density.
        held_out_errors, held_out_nll: the same on its held-out samples that may choose.
        config: every value as text, by its dotted key.
        epochs: epochs trained before each row of `metrics`; 0 is the untrained network.
        metrics: a series per key, None in rows without it.
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
        """Preset, data set, model and name."""
        return f"{self.preset}/{self.data}/{self.model}/{self.name}"

    @property
    def digest(self) -> str:
        """The hash of the overrides in its name, equal for all seeds and models with the same ones; else empty."""
        return self.name.partition("-")[2]

    @property
    def slug(self) -> str:
        """The path as a file name."""
        return file_stem(*self.folder.names)


def read_run(folder: RunFolder, kept: Path | None = None) -> Run:
    """Read and measure a run inside its boundary; the folder `kept` stores measurements until the run changes."""
    notes = Notes()
    return notes.attempt(partial(_whole_run, unreadable(folder, []), kept, notes)) or unreadable(folder, notes)


def unreadable(folder: RunFolder, notes: Sequence[str]) -> Run:
    """A run of which only the place is shown, and the reasons."""
    preset, data, model, name = map(printable, folder.names)
    return Run(folder, preset, data, model, name, detail="; ".join(notes[-1:]), notes=notes)


def _whole_run(run: Run, kept: Path | None, notes: Notes) -> Run:
    folder, leaf = run.folder, LEAF.fullmatch(run.name)
    status = notes.attempt(folder.status)
    state, detail = _state(folder) if status else ("unreadable", notes[-1])
    if leaf is None:
        state, detail = "unreadable", f"{run.name}: expected a folder named seed<k> or seed<k>-<hash>"
    values = notes.attempt(lambda: flatten(folder.config())) or {}
    config = {key: "" if value is None else str(value) for key, value in values.items()}
    rows = notes.attempt(folder.metrics) or []
    notes.attempt(lambda: _check_whole(folder, values, rows, state))
    predictions = _table(folder.predictions, notes, needed=state == "finished")
    errors, nll = _tested(run, predictions, notes) if state == "finished" else ({}, None)
    if state == "finished" and not errors:
        state, detail = "unreadable", notes[-1] + f"; {AGAIN}" * (not notes[-1].endswith(READABLE))
    held_out = _table(folder.held_out, notes)
    chosen = {name: column[choosing(held_out)] for name, column in held_out.items()} if held_out else {}
    held_out_errors, held_out_nll = _errors(chosen, ("mode",), notes)
    measuring = partial(measure, folder, config, predictions, held_out)
    stored = partial(kept_or_measured, folder, config, measuring, kept) if kept else measuring
    measured = notes.attempt(stored) or Measured()
    return replace(
        run,
        seed=int(leaf[1]) if leaf else None,
        state=state,
        overrides=_overrides(status, run.digest),
        detail=one_line(detail),
        status=status,
        errors=errors,
        nll=nll,
        held_out_errors=held_out_errors,
        held_out_nll=held_out_nll,
        config=config,
        epochs=[row["epoch"] + 1 for row in rows],
        metrics=_series(rows),
        measured=measured,
        notes=list(dict.fromkeys([*notes, *measured.notes])),
    )


def _check_whole(folder: RunFolder, config: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], state: str) -> None:
    """Raise RunError for half a file: a configuration without its last sections, or too few epochs."""
    sections = {key.partition(".")[0] for key in config}
    if config and (lacking := [name for name in SECTIONS if name not in sections]):
        raise RunError(f"{folder.config_file}: incomplete, without {', '.join(lacking)}")
    if state != "finished" or not folder.results_file.exists():
        return
    trained, last = folder.results().get("epochs"), max((row["epoch"] for row in rows), default=-1)
    if isinstance(trained, int) and last + 1 < trained:
        raise RunError(f"{folder.metrics_file}: incomplete, with {last + 1} of {trained} epochs")


def _table(file: Path, notes: Notes, needed: bool = False) -> Arrays | None:
    return notes.attempt(partial(read_table, file)) if needed or file.exists() else None


def _tested(run: Run, predictions: Arrays | None, notes: Notes) -> tuple[MeanErrors, float | None]:
    """The errors of all point estimates, those of eight views included, and the NLL."""
    errors, nll = _errors(predictions, tuple(COLUMNS) if run.model == PROBABILISTIC else ("mode",), notes)
    of_eight, _ = _errors(_table(run.folder.eight_views["test"], notes) if errors else None, ("mode",), notes)
    return {**errors, **{replace(key, estimate="eight views"): mean for key, mean in of_eight.items()}}, nll


def _errors(table: Arrays | None, estimates: Sequence[Estimate], notes: Notes) -> tuple[MeanErrors, float | None]:
    """Mean errors and NLL, as far as they are known; no errors if the table cannot be measured."""
    errors = notes.attempt(lambda: mean_errors(table, estimates)) if table else None
    nll = float(table["nll"].mean()) if table and errors and "nll" in table else math.nan
    return errors or {}, nll if math.isfinite(nll) else None


def _state(folder: RunFolder) -> tuple[RunState, str]:
    try:
        state, error = folder.state()
    except OSError as error:  # a read-only folder
        return "running", f"or interrupted: its lock cannot be tried ({error.strerror})"
    return state or "unreadable", error or ("the same command resumes it" if state == "interrupted" else "")


def _series(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[float | None]]:
    keys = sorted({key for row in rows for key in row} - {"epoch", "step"})
    return {key: [None if row.get(key) is None else float(row[key]) for row in rows] for key in keys}


def _overrides(status: RunStatus | None, digest: str) -> str | None:
    words = status.overrides if status else []
    changing = [word for word in words if has_influence(word.lstrip("+~").partition("=")[0])]
    return one_line(" ".join(changing)) or digest or None

"""Every recorded run under a folder, with its state and, once it has finished, its mean errors."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from phd_exp.evaluation.point_errors import COLUMNS, Estimate, MeanErrors, mean_errors, mean_nll
from phd_exp.records.choices import flatten, has_influence
from phd_exp.records.errors import RunError
from phd_exp.records.runs import RunFolder, RunStatus, find_runs

RunState = Literal["finished", "running", "broken off", "failed", "unreadable"]
PROBABILISTIC = "probabilistic"
LEAF = re.compile(r"seed(0|[1-9][0-9]*)(-[0-9a-f]{8})?")


@dataclass(frozen=True)
class Run:
    """One run: its choices, how it stands, and what it reached.

    Attributes:
        seed: None where the folder's name is none that a run is given.
        overrides: None of a run as its preset says; else what else was asked for, as far as it can be told.
        detail: one line on a state other than finished.
        errors: of a finished run.
        nll: mean over the test samples, nats; None for a model without a density.
    """

    folder: RunFolder
    preset: str
    data: str
    model: str
    seed: int | None
    state: RunState
    overrides: str | None = None
    detail: str = ""
    errors: MeanErrors = field(default_factory=dict)
    nll: float | None = None


@dataclass(frozen=True)
class Records:
    """All runs under a folder, by their paths."""

    folder: Path
    runs: tuple[Run, ...]

    @property
    def presets(self) -> list[str]:
        """All presets, with their recipes, in order."""
        return sorted({run.preset for run in self.runs})

    def at_defaults(self, preset: str, data: str, model: str) -> dict[int, Run]:
        """Seed -> run, of those runs alone in which nothing but preset, data set, model and seed was chosen."""
        choice = (preset, data, model)
        return {
            run.seed: run
            for run in self.runs
            if run.seed is not None and run.overrides is None and (run.preset, run.data, run.model) == choice
        }


def collect(runs: Path) -> Records:
    """Read every run; one whose record is broken is named with its error and stops no other."""
    return Records(runs, tuple(_run(folder, runs) for folder in find_runs(runs)))


def estimates_of(model: str) -> tuple[Estimate, ...]:
    """A distribution has three point estimates, every other model one."""
    return tuple(COLUMNS) if model == PROBABILISTIC else ("mode",)


def _run(folder: RunFolder, runs: Path) -> Run:
    preset, data, model, leaf = folder.path.relative_to(runs).parts
    name = LEAF.fullmatch(leaf)
    seed = int(name[1]) if name else None
    overrides = _overrides(folder) if name and name[2] else None
    state, detail = _state(folder)
    errors: MeanErrors = {}
    if name is None:
        state, detail = "unreadable", f"{leaf} is no name of a run; expected seed<k> or seed<k>-<hash>"
    elif state == "finished":
        try:
            errors = mean_errors(folder.predictions, estimates_of(model))
        except RunError as error:
            state, detail = "unreadable", f"{error}; delete the folder to run again"
    nll = mean_nll(folder.predictions) if errors else None
    return Run(folder, preset, data, model, seed, state, overrides, " ".join(detail.split()), errors, nll)


def _state(folder: RunFolder) -> tuple[RunState, str]:
    try:
        status = folder.status()
    except (RunError, OSError) as error:
        return "unreadable", str(error)
    if status is None:  # gone since the folder was listed
        return "unreadable", f"{folder.status_file.name}: missing"
    if status.state == "running":
        return _running(folder)
    return _ended(status)


def _running(folder: RunFolder) -> tuple[RunState, str]:
    try:
        alive = folder.is_held()
    except OSError as error:  # a lock cannot be tried in a folder that is read-only
        return "running", f"or broken off: its lock cannot be tried ({error.strerror})"
    return ("running", "") if alive else ("broken off", "the same command goes on")


def _ended(status: RunStatus) -> tuple[RunState, str]:
    if status.state == "finished":
        return "finished", ""
    state: RunState = "failed" if status.state == "failed" else "broken off"
    return state, status.error or ""


def _overrides(folder: RunFolder) -> str:
    """What sets a run apart: where its configuration differs from that of a run beside it without overrides."""
    for path in sorted(folder.path.parent.glob("seed*")):
        if "-" in path.name:
            continue
        try:
            changes = _changes(RunFolder(path).config(), folder.config())
        except (RunError, OSError):
            continue
        return ", ".join(f"{key}={value}" for key, value in changes.items()) or "nothing that differs"
    return "not told: no run without overrides to compare with"


def _changes(before: dict[str, Any], now: dict[str, Any]) -> dict[str, Any]:
    """By their keys with dots. Of a part made by another class its name, and what both classes take."""
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

"""The run record: everything a run leaves on disk, readable without the model that made it.

    runs/<preset>[+<recipe>]/<data>/<model>/seed<k>[-<hash of other overrides>]/
        config.yaml          what was asked for, resolved
        constants.json       constants of the data set (depth scale, focal length) and the version of shrinking
        status.json          state, error, versions, git commit, hash of the data set
        metrics.jsonl        one line an epoch
        results.json         the final numbers
        predictions.parquet  per test sample: truth, parameters, estimate, errors
        held_out.parquet     the same of training samples that were held out, for recalibration
        views.parquet        the same of scenes that several cameras see, with their poses, where that was asked for
        calibration/         the calibration curves, as data (JSON) and as pictures (PNG)
        checkpoints/         last.ckpt
        wandb/               the same for wandb, ready for `wandb sync`

A run is named by its choices, never by a date, so that the same command resumes it or finds it finished.
"""

import json
import math
import os
import traceback
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import yaml
from filelock import FileLock, Timeout
from pydantic import AwareDatetime, BaseModel, ConfigDict, ValidationError

from phd_exp.records import provenance
from phd_exp.records.errors import RunError, gist
from phd_exp.records.files import MB, read_jsonl, read_plain, write_atomic
from phd_exp.records.parsing import parse_json, parse_yaml

LAST_EPOCH = 10**9
LARGEST = MB
"""Bytes of a configuration or of a run's numbers."""

State = Literal["running", "finished", "failed", "interrupted"]


class RunStatus(BaseModel):
    """How a run stands, and what it ran on; times in UTC."""

    model_config = ConfigDict(extra="forbid")

    state: State
    started: AwareDatetime
    ended: AwareDatetime | None = None
    error: str | None = None
    traceback: str | None = None
    versions: dict[str, str]
    git_commit: str | None
    data_manifest: str | None
    machine: str


class RunFolder:
    """One run's folder: typed access to its files, each written beside itself and renamed into place."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.checkpoints = path / "checkpoints"
        self.calibration = path / "calibration"
        self.wandb = path / "wandb"
        self.predictions = path / "predictions.parquet"
        self.held_out = path / "held_out.parquet"
        self.views = path / "views.parquet"
        self.results_file = path / "results.json"
        self.metrics_file = path / "metrics.jsonl"
        self.status_file = path / "status.json"
        self.config_file = path / "config.yaml"
        self.constants_file = path / "constants.json"

    def curves(self, name: str) -> Path:
        """Calibration curves, of an epoch or "final"; their picture, if there is one, differs in the suffix."""
        return self.calibration / f"{name}.json"

    @property
    def last_checkpoint(self) -> Path:
        """What a run goes on from."""
        return self.checkpoints / "last.ckpt"

    def status(self) -> RunStatus | None:
        """The recorded status; None where there is none. Raises RunError where it cannot be read."""
        if not self.status_file.exists():
            return None
        try:
            return RunStatus.model_validate_json(read_plain(self.status_file))
        except (ValidationError, OSError) as error:
            raise _unreadable(self.status_file, "not a run status", error) from None

    def is_finished(self) -> bool:
        """Whether the run has ended well. Raises RunError where its status cannot be read."""
        status = self.status()
        return status is not None and status.state == "finished"

    def _lock(self) -> FileLock:
        return FileLock(self.path / ".lock", timeout=0)

    def _require_own_folders(self) -> None:
        """Raise RunError where what is written into the run, which may be somebody else's, would go elsewhere."""
        for place in (self.checkpoints, self.calibration, self.wandb):
            if place.is_symlink():
                raise RunError(f"{place}: leads out of the run's folder; put the folder itself in its place")

    def is_held(self) -> bool:
        """Whether a process works on the run now."""
        try:
            with self._lock():
                return False
        except Timeout:
            return True

    def config(self) -> dict[str, Any]:
        """The configuration, resolved. Raises RunError where it is missing or cannot be read."""
        return _read_mapping(self.config_file, parse_yaml)

    def results(self) -> dict[str, Any]:
        """The final numbers. Raises RunError where they are missing or cannot be read."""
        return _read_mapping(self.results_file, parse_json)

    def constants(self) -> dict[str, Any]:
        """What the network was told of the data set. Raises RunError as `config` does."""
        return _read_mapping(self.constants_file, parse_json)

    def metrics(self) -> list[dict[str, Any]]:
        """One mapping an epoch, as logged; a last line torn by a kill is left out.

        Raises CorruptFileError for a line that is none, OSError where the file cannot be read.
        """
        return read_jsonl(self.metrics_file, _metrics_row) if self.metrics_file.exists() else []

    def write_config(self, config: Mapping[str, Any]) -> None:
        """Write the configuration, resolved."""
        write_atomic(self.config_file, yaml.safe_dump(dict(config), sort_keys=False))

    def write_constants(self, constants: Mapping[str, float]) -> None:
        """Write what the network is told of the data set; all numbers are finite."""
        write_atomic(self.constants_file, json.dumps(dict(constants), indent=2, allow_nan=False) + "\n")

    def write_results(self, results: Mapping[str, Any]) -> None:
        """Write the final numbers; null stands for one that is not finite, which JSON does not know."""
        finite = {key: None if _is_infinite(value) else value for key, value in results.items()}
        write_atomic(self.results_file, json.dumps(finite, indent=2, allow_nan=False) + "\n")

    def write_status(self, status: RunStatus) -> None:
        """Write how the run stands."""
        write_atomic(self.status_file, status.model_dump_json(indent=2) + "\n")

    def write_metrics(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Write all lines anew, one an epoch."""
        write_atomic(self.metrics_file, "".join(json.dumps(row) + "\n" for row in rows))

    def require_writable(self) -> None:
        """Raise RunError where the folder could not be made, before hours are spent on what goes into it."""
        nearest = next(path for path in (self.path, *self.path.absolute().parents) if path.exists())
        if not (nearest.is_dir() and os.access(nearest, os.W_OK)):
            raise RunError(
                f"{self.path}: cannot be written ({nearest} is in the way or read-only); choose runs=DIR"
            )

    @contextmanager
    def held(self) -> Iterator[None]:
        """Hold the folder for this process alone. Raises RunError where another process has it."""
        lock = self._lock()
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            self._require_own_folders()
            lock.acquire()
        except Timeout:
            raise RunError(
                f"{self.path}: another process is working on this run; wait for it or stop it"
            ) from None
        except OSError as error:
            raise RunError(
                f"{self.path}: cannot be written ({error.strerror}); choose another folder by runs=DIR"
            ) from None
        try:
            yield
        finally:
            lock.release()

    @contextmanager
    def recording(self, data_manifest: str | None) -> Iterator[None]:
        """Record how the enclosed work ends: finished, failed with its traceback, or interrupted."""
        status = _new_status(data_manifest)
        self.write_status(status)
        try:
            yield
        except Exception as error:
            line = f"{type(error).__name__}: {error}"
            with suppress(OSError):  # on a full disk, what is to be said is what was wrong first
                self.write_status(_ended(status, "failed", error=line, trace=traceback.format_exc()))
            raise
        except BaseException as stop:
            with suppress(OSError):
                self.write_status(_ended(status, "interrupted", error=f"{type(stop).__name__}: {stop}"))
            raise
        self.write_status(_ended(status, "finished"))


def epoch_name(epoch: int) -> str:
    """What files of an epoch are called."""
    return f"epoch-{epoch:04d}"


def find_runs(runs: Path) -> list[RunFolder]:
    """Every run recorded under a folder, in the order of their paths."""
    return [RunFolder(file.parent) for file in sorted(runs.glob("*/*/*/seed*/status.json"))]


def _metrics_row(text: str) -> dict[str, Any]:
    row = parse_json(text)
    if not isinstance(row, dict):
        raise ValueError(f"expected a mapping, found {type(row).__name__}")
    epoch = row.get("epoch")
    if type(epoch) is not int or not -1 <= epoch <= LAST_EPOCH:
        raise ValueError(f"epoch: expected a whole number from -1 to {LAST_EPOCH}")
    return row


def _is_infinite(value: Any) -> bool:
    return isinstance(value, float) and not math.isfinite(value)


def _read_mapping(file: Path, parse: Any) -> dict[str, Any]:
    try:
        content = parse(read_plain(file, LARGEST).decode())
    except FileNotFoundError:
        raise RunError(f"{file}: missing; the run has not written it yet") from None
    except (ValueError, OSError) as error:
        raise _unreadable(file, "cannot be read", error) from None
    if not isinstance(content, dict):
        raise RunError(f"{file}: expected a mapping, found {type(content).__name__}")
    return content


def _unreadable(file: Path, complaint: str, error: Exception) -> RunError:
    return RunError(f"{file}: {complaint} ({gist(error)}); delete the folder to run again")


def _new_status(data_manifest: str | None) -> RunStatus:
    return RunStatus(
        state="running",
        started=datetime.now(UTC),
        versions=provenance.versions(),
        git_commit=provenance.git_commit(),
        data_manifest=data_manifest,
        machine=provenance.machine(),
    )


def _ended(status: RunStatus, state: State, error: str | None = None, trace: str | None = None) -> RunStatus:
    return status.model_copy(
        update={"state": state, "ended": datetime.now(UTC), "error": error, "traceback": trace}
    )

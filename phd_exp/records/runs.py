"""The run record: all files of a run, readable without the model that made them.

    runs/<preset>[+<recipe>]/<data>/<model>/seed<k>[-<hash of other overrides>]/
        config.yaml          the configuration, resolved
        constants.json       constants of the data set (depth scale, focal length); versions of its images
        status.json          state, error, versions, git commit, hash of the data set
        metrics.jsonl        one line per epoch
        results.json         the final numbers
        predictions.parquet  per test sample: truth, parameters, estimate, errors
        held_out.parquet     the same for held-out training samples; see `choosing`
        eight_views_*.parquet  the same two from the eight symmetric views of each image, and the views' disagreement
        views.parquet        the same for scenes with several cameras, and their poses, if asked for
        labelled/            the same for labelled images by `calibrate`, a table NAME.parquet for each
        sequences/           the same for sequences, by their frames: 20.parquet, 20-held-out.parquet; see `HELD_OUT`
        shifts/              the same for shifted test samples, a table NAME.parquet for each, if asked for
        calibration/         the calibration curves, as data (JSON) and as pictures (PNG)
        checkpoints/         last.ckpt; best.ckpt with callbacks=best_checkpoint
        wandb/               the same for wandb, ready for `wandb sync`; likewise for other loggers

The name of a run encodes its choices, never a date: the same command resumes the run or finds it finished.
"""

import json
import math
import os
import platform
import subprocess
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import AwareDatetime, BaseModel, Field, FiniteFloat, StrictInt

from phd_exp.records.errors import RunError, reading, writing
from phd_exp.records.files import MB, read_jsonl, read_plain, write_atomic
from phd_exp.records.parsing import Record, parse_json, parse_yaml
from phd_exp.records.processes import held, machine

AGAIN = "delete the folder to run again"
HELD_OUT = "-held-out"  # of sequences of another seed, which choose the motion and the slow errors
UNSHIFTED = "home"  # the unchanged test samples, among shifts
SECTIONS = ("data", "model", "camera", "recipe", "backbone", "loss", "optimizer", "trainer", "evaluation")
"""Sections that every configuration has."""
LARGEST = MB  # bytes of a configuration or of a run's numbers
PACKAGES = ("phd_exp", "torch", "torchvision", "lightning", "hydra-core", "numpy")
"""Packages on which numbers depend, whose versions are recorded."""

State = Literal["running", "finished", "failed", "interrupted"]


class RunStatus(Record):
    """State of a run, and the software and machine it ran on; times in UTC.

    `custom` are the user's own classes and functions, with the files that define them; `overrides` the words of the
    command line that are not part of the run's name.
    """

    state: State
    started: AwareDatetime
    ended: AwareDatetime | None = None
    error: str | None = None
    traceback: str | None = None
    versions: dict[str, str]
    git_commit: str | None
    data_manifest: str | None
    custom: dict[str, str] = Field(default_factory=dict)
    overrides: list[str] = Field(default_factory=list)
    machine: str


class Epoch(BaseModel, extra="allow"):
    """A line of `metrics.jsonl`: the epoch, -1 before the first, and numbers by their names."""

    __pydantic_extra__: dict[str, StrictInt | FiniteFloat | None] = Field(init=False)
    epoch: Annotated[StrictInt, Field(ge=-1, le=10**9)]

    @classmethod
    def parsed(cls, text: str) -> dict[str, Any]:
        """The numbers of a line. Raises ValueError if they are none."""
        return cls.model_validate(parse_json(text)).model_dump()


def choosing(columns: Mapping[str, Any]) -> np.ndarray:
    """Which rows of held-out samples choose; the others guarantee. Every second `block`, by default a row, chooses.

    The rows of a block, such as the frames of a video, are dependent. The training uses the first rows to choose
    epochs, trials of a search and recipes. For guaranteed regions, they determine temperatures and borders of groups,
    the others the thresholds. Without guaranteed regions, temperatures are fitted to all rows.
    """
    block = columns.get("block", range(len(next(iter(columns.values())))))
    _, first, place = np.unique(block, return_index=True, return_inverse=True)
    return np.asarray(first.argsort().argsort()[place] % 2 == 0)


class RunFolder:
    """One run's folder: typed access to its files, each written to a temporary name and renamed into place.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as place:
        ...     run = RunFolder(Path(place))
        ...     run.write_results({"test/nll": -1.5})
        ...     run.results()
        {'test/nll': -1.5}
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.checkpoints = path / "checkpoints"
        self.last_checkpoint = self.checkpoints / "last.ckpt"  # from which a run resumes
        self.calibration = path / "calibration"
        self.predictions = path / "predictions.parquet"
        self.held_out = path / "held_out.parquet"
        self.views = path / "views.parquet"
        self.shifts = path / "shifts"
        self.sequences = path / "sequences"
        self.eight_views = {part: path / f"eight_views_{part}.parquet" for part in ("held_out", "test")}
        self.results_file = path / "results.json"
        self.metrics_file = path / "metrics.jsonl"
        self.status_file = path / "status.json"
        self.config_file = path / "config.yaml"
        self.constants_file = path / "constants.json"

    @property
    def names(self) -> tuple[str, str, str, str]:
        """Preset (with its recipe), data set, model, and seed with the hash of other overrides: its place's names."""
        preset, data, model, leaf = self.path.parts[-4:]
        return preset, data, model, leaf

    def curves(self, name: str) -> Path:
        """Calibration curves, of an epoch or "final"; the picture, if there is one, has another suffix."""
        return self.calibration / f"{name}.json"

    def shift(self, name: str) -> Path:
        """Predictions of shifted test samples."""
        return self.shifts / f"{name}.parquet"

    def sequence(self, frames: int, *, held_out: bool) -> Path:
        """Predictions of sequences of so many frames: those tested, or other ones that choose."""
        return self.sequences / f"{frames}{HELD_OUT if held_out else ''}.parquet"

    def labelled(self, name: str) -> Path:
        """Predictions of the user's labelled images, by `calibrate`."""
        return self.path / "labelled" / f"{name}.parquet"

    @property
    def best_checkpoint(self) -> Path:
        """The checkpoint that is evaluated and predicts: of callbacks=best_checkpoint, otherwise the last."""
        best = self.checkpoints / "best.ckpt"
        return best if best.exists() else self.last_checkpoint

    def status(self) -> RunStatus | None:
        """The recorded status, or None. Raises RunError if it cannot be read."""
        if not self.status_file.exists():
            return None
        with reading(self.status_file, AGAIN, RunError, "not a run status"):
            return RunStatus.model_validate_json(read_plain(self.status_file))

    def is_finished(self) -> bool:
        """Whether the run ended without an error. Raises RunError if its status cannot be read."""
        status = self.status()
        return status is not None and status.state == "finished"

    def state(self) -> tuple[State | None, str]:
        """The state now, and the error that ended the run; a process that died leaves it interrupted, without one.

        None without a record. Raises RunError if the status cannot be read, OSError if the lock cannot be tried.
        """
        status = self.status()
        if status is None or status.state != "running":
            return (status.state, status.error or "") if status else (None, "")
        return ("running" if self.is_held() else "interrupted"), ""

    def is_held(self) -> bool:
        """Whether a process works on the run now. Raises OSError if the lock cannot be tried."""
        with held(self.path / ".lock") as free:
            return not free

    def config(self) -> dict[str, Any]:
        """The configuration, resolved. Raises RunError if it is missing or cannot be read."""
        return _read_mapping(self.config_file, parse_yaml)

    def results(self) -> dict[str, Any]:
        """The final numbers. Raises RunError as `config` does."""
        return _read_mapping(self.results_file, parse_json)

    def constants(self) -> dict[str, Any]:
        """The network's constants of the data set. Raises RunError as `config` does."""
        return _read_mapping(self.constants_file, parse_json)

    def metrics(self) -> list[dict[str, Any]]:
        """One mapping per epoch, as logged, without a last line that a kill left incomplete.

        Raises CorruptFileError for an invalid line, OSError if the file cannot be read.
        """
        return read_jsonl(self.metrics_file, Epoch.parsed) if self.metrics_file.exists() else []

    def write_config(self, config: Mapping[str, Any]) -> None:
        """Write the configuration, resolved."""
        write_atomic(self.config_file, yaml.safe_dump(dict(config), sort_keys=False))

    def write_constants(self, constants: Mapping[str, float]) -> None:
        """Write the network's constants of the data set; all numbers are finite."""
        write_atomic(self.constants_file, json.dumps(dict(constants), indent=2, allow_nan=False) + "\n")

    def write_results(self, results: Mapping[str, Any]) -> None:
        """Write the final numbers, with null for those that are not finite, which JSON lacks."""
        infinite = {key for key, value in results.items() if isinstance(value, float) and not math.isfinite(value)}
        finite = {**results, **dict.fromkeys(infinite)}
        write_atomic(self.results_file, json.dumps(finite, indent=2, allow_nan=False) + "\n")

    def write_status(self, status: RunStatus) -> None:
        """Write the status."""
        write_atomic(self.status_file, status.model_dump_json(indent=2) + "\n")

    def write_metrics(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Replace all lines, one per epoch."""
        write_atomic(self.metrics_file, "".join(json.dumps(row) + "\n" for row in rows))

    def require_writable(self) -> None:
        """Raise RunError if the folder could not be made, before hours of computation."""
        nearest = next(path for path in (self.path, *self.path.absolute().parents) if path.exists())
        if not (nearest.is_dir() and os.access(nearest, os.W_OK)):
            raise RunError(f"{self.path}: cannot be written ({nearest} is in the way or read-only); choose runs=DIR")

    @contextmanager
    def held(self) -> Iterator[None]:
        """Hold the folder exclusively. Raises RunError if another process holds it, or it cannot be written."""
        lock = ExitStack()
        with writing(self.path, "runs=DIR", RunError):
            self.path.mkdir(parents=True, exist_ok=True)
            ours = (self.checkpoints, self.calibration, self.shifts, self.sequences, self.path / "labelled")
            for place in (*self.path.iterdir(), *(file for folder in ours for file in folder.glob("*"))):
                if place.is_symlink():  # in a stranger's run, it would redirect what is written
                    raise RunError(f"{place}: is a link; put the file or folder itself in its place")
            free = lock.enter_context(held(self.path / ".lock"))
        with lock:
            if not free:
                raise RunError(f"{self.path}: another process is working on this run; wait for it or stop it")
            yield

    @contextmanager
    def recording(
        self, data_manifest: str | None, custom: Mapping[str, str] | None = None, overrides: Sequence[str] = ()
    ) -> Iterator[None]:
        """Record how the enclosed work ends: finished, failed with its traceback, or interrupted."""
        status = RunStatus(
            state="running",
            started=datetime.now(UTC),
            versions=versions(),
            git_commit=git_commit(),
            data_manifest=data_manifest,
            custom=dict(custom or {}),
            overrides=list(overrides),
            machine=machine(),
        )

        def ended(state: State, **details: str | None) -> None:
            self.write_status(status.model_copy(update={"state": state, "ended": datetime.now(UTC), **details}))

        self.write_status(status)
        try:
            yield
        except BaseException as error:
            lines = traceback.format_exc() if isinstance(error, Exception) else None
            with suppress(OSError):  # on a full disk, the first error is the one to raise
                state: State = "failed" if lines else "interrupted"
                ended(state, error=f"{type(error).__name__}: {error}", traceback=lines)
            raise
        ended("finished")


def epoch_name(epoch: int) -> str:
    """Name of the files of an epoch."""
    return f"epoch-{epoch:04d}"


def find_runs(runs: Path) -> list[RunFolder]:
    """All runs recorded under a folder, in the order of their paths."""
    return [RunFolder(file.parent) for file in sorted(runs.glob("*/*/*/seed*/status.json"))]


def _read_mapping(file: Path, parse: Callable[[str], Any]) -> dict[str, Any]:
    with reading(file, AGAIN, RunError):
        content = parse(read_plain(file, LARGEST).decode())
        if not isinstance(content, dict):
            raise ValueError(f"a {type(content).__name__}; expected a mapping")
        return content


def versions() -> dict[str, str]:
    """Installed versions of Python and of the packages on which numbers depend."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        with suppress(PackageNotFoundError):  # phd_exp may run from a checkout that is not installed
            found[name] = version(name)
    return found


def git_commit() -> str | None:
    """The commit of this package's checkout, or None outside one or without git."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    with suppress(OSError, subprocess.SubprocessError):
        return subprocess.run(command, capture_output=True, text=True, timeout=10, check=True).stdout.strip()
    return None

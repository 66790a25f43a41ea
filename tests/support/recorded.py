"""Run folders in the format of a training, with predictions drawn by a test."""

import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from filelock import FileLock

from phd_exp.cli import report
from phd_exp.records.choices import RunName
from phd_exp.records.runs import RunFolder, RunStatus, find_runs
from phd_exp.reports.files import all_tables
from phd_exp.reports.report import read_report
from phd_exp.reports.site import build

COORDINATES = ("x", "y", "z")
DATA = ("default", "occl", "scale", "occl_scale")
ODD_PRESET = "a_b & [red]|c| `$1` %"


@dataclass(frozen=True)
class Predicted:
    """The table of a run, and the positions behind it."""

    frame: pd.DataFrame
    truth: np.ndarray
    estimates: dict[str, np.ndarray]
    v_p: np.ndarray


def predicted(seed: int, n: int = 40, noise: float = 0.02, probabilistic: bool = True) -> Predicted:
    """Truths all over the field of view, and estimates about them; `noise` is relative."""
    random = np.random.default_rng(seed)
    f, z = random.uniform(1200, 2000, n), random.uniform(3, 5, n)
    v_p = random.uniform(-1, 1, (n, 2))
    truth = np.column_stack([v_p * (224 * z / (2 * f))[:, None], z])
    mode = truth * (1 + noise * random.standard_normal((n, 3)))
    mu_xy = mode[:, :2] / mode[:, 2:]
    median_z = mode[:, 2] * random.uniform(0.98, 1.0, n)
    estimates = {
        "mode": mode,
        "mean": mode * random.uniform(1.0, 1.02, (n, 1)),
        "median": np.column_stack([median_z[:, None] * mu_xy, median_z]),
    }
    columns = {"f": f, "S": np.full(n, 224), **dict(zip(COORDINATES, truth.T, strict=True))}
    columns |= {f"mode_{axis}": column for axis, column in zip(COORDINATES, mode.T, strict=True)}
    if probabilistic:
        columns |= {f"mean_{axis}": estimates["mean"][:, place] for place, axis in enumerate(COORDINATES)}
        columns |= {"median_z": median_z, "mu_x": mu_xy[:, 0], "mu_y": mu_xy[:, 1]}
        columns["nll"] = random.standard_normal(n)
    return Predicted(pd.DataFrame(columns), truth, estimates, v_p)


def by_hand(drawn: Predicted, estimate: str, quantity: str) -> np.ndarray:
    """Sine and cosine between the true ray and the estimate, by cross and dot product; millimetres."""
    v, v_hat = drawn.truth, drawn.estimates[estimate]
    length = np.sqrt((v**2).sum(axis=1))
    across = np.sqrt((np.cross(v, v_hat) ** 2).sum(axis=1)) / length
    along = (v * v_hat).sum(axis=1) / length
    return 1000 * (across if quantity == "projected" else np.abs(along - length))


def record(
    runs: Path,
    data: str,
    model: str,
    seed: int = 0,
    frame: pd.DataFrame | None = None,
    preset: str = "small",
    overrides: tuple[str, ...] = (),
) -> RunFolder:
    """A finished run with these predictions, or without the file."""
    folder = RunFolder(RunName(preset, data, model, seed, overrides).folder(runs))
    folder.path.mkdir(parents=True)
    with folder.recording(data_manifest=None, overrides=overrides):
        if frame is not None:
            frame.to_parquet(folder.predictions)
    return folder


def only_run(runs: Path) -> RunFolder:
    """The one run that is recorded there."""
    (run,) = find_runs(runs)
    return run


def weights(run: RunFolder) -> dict[str, torch.Tensor]:
    """The network's weights in its last checkpoint."""
    state = torch.load(run.last_checkpoint, weights_only=True)["state_dict"]
    return {name: weight for name, weight in state.items() if name.startswith("regressor.")}


def stamps(run: RunFolder) -> dict[str, int]:
    """When each file of a run was written, ns."""
    files = [file for file in run.path.rglob("*") if file.is_file() and file.name != ".lock"]
    return {file.relative_to(run.path).as_posix(): file.stat().st_mtime_ns for file in files}


HOSTILE = "\\end{table} $x_1$ & 5 % #1 ^~ {a} |b| `c` **d** <script> [red]e[/red] \x1b[31m 中 ' \" --"
"""An error's message with markup of every format, and a control sequence of the terminal."""


def status_of(run: RunFolder, **changes: Any) -> RunStatus:
    """The status of a run that has one, written anew if anything changes."""
    status = run.status()
    status = status.model_copy(update=changes)
    if changes:
        run.write_status(status)
    return status


def fail(runs: Path, data: str, model: str, seed: int = 0) -> None:
    """A run that failed."""
    folder = RunFolder(RunName("small", data, model, seed).folder(runs))
    folder.path.mkdir(parents=True)
    with suppress(ValueError), folder.recording(data_manifest=None):
        raise ValueError(HOSTILE)


def both_tables(runs: Path) -> dict[tuple[str, str, int], Predicted]:
    """Two seeds of every run of both tables except one failed and two missing runs, and another preset."""
    absent = (("mae_vz", "scale", 1), ("mae_logz", "occl", 0), ("mae_logz", "occl", 1))
    choices = list(product(("mae_vz", "mae_logz", "probabilistic"), DATA))
    drawn: dict[tuple[str, str, int], Predicted] = {}
    for model, data in [*choices, ("mae_xyz", "default"), ("mae_constf", "default")]:
        for seed in (0, 1):
            if (model, data, seed) not in absent:
                number = len(drawn)
                point = predicted(number, noise=0.01 + 0.001 * number, probabilistic=model == "probabilistic")
                drawn[model, data, seed] = point
                record(runs, data, model, seed, point.frame)
    fail(runs, "scale", "mae_vz", 1)
    record(runs, "default", "mae_xyz", 0, predicted(99, probabilistic=False).frame, preset=ODD_PRESET)
    return drawn


def reported(runs: Path, out: Path) -> None:
    """Run the command `report` on these runs."""
    assert report.main([f"runs={runs}", f"out={out}"]) == 0


def sited(runs: Path, out: Path) -> Path:
    """The pages of these runs, without the figures and tables of a paper."""
    found = read_report(runs, out / "measured")
    return build.write_site(found, all_tables(found), [], out / "site").parent


def shared(factory: pytest.TempPathFactory) -> Path:
    """The folder of all test processes."""
    base = factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


def once(factory: pytest.TempPathFactory, name: str, build: Callable[[Path], None]) -> Path:
    """A folder built by the first test process for all others."""
    folder = shared(factory) / name
    with FileLock(folder.with_suffix(".lock")):
        if not folder.exists():
            folder.mkdir()
            build(folder)
    return folder

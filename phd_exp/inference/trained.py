"""A recorded run in Python: its numbers, its predictions and its network; and all runs as a table."""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from phd_exp.evaluation.parquet import read_table
from phd_exp.inference.loading import load
from phd_exp.inference.predictor import Predictor
from phd_exp.records.choices import preset_and_recipe
from phd_exp.records.errors import RunError
from phd_exp.records.runs import RunFolder, find_runs


@dataclass(frozen=True)
class TrainedRun:
    """A finished run, as `phd_exp.train` returns it; `path` is its folder."""

    path: Path

    @property
    def results(self) -> dict[str, Any]:
        """The final numbers, such as `test/nll` (nats) and `test/depth_error_mm`."""
        return RunFolder(self.path).results()

    @property
    def predictions(self) -> Mapping[str, np.ndarray]:
        """Column -> one value per test sample: the true position, the prediction, errors and scores."""
        return read_table(RunFolder(self.path).predictions)

    def predictor(self, device: str = "auto", recalibrate: bool = False) -> Predictor:
        """The network as a callable; the user's own parts are trusted, because the user has named them."""
        return load(self.path, device, recalibrate, trust=None)


def runs_table(folder: Path) -> Any:
    """One row for each run under a folder: its names, state and final numbers.

    Returns a pandas DataFrame, or a list of dictionaries if pandas is not installed. An unreadable record has the
    state `unreadable`.
    """
    rows = [_row(run) for run in find_runs(folder)]
    if find_spec("pandas") is None:
        return rows
    import pandas as pd

    return pd.DataFrame(rows)


def _row(run: RunFolder) -> dict[str, Any]:
    setting, data, model, leaf = run.names
    preset, recipe = preset_and_recipe(setting)
    row = {"preset": preset, "recipe": recipe, "data": data, "model": model, "run": leaf, "path": str(run.path)}
    try:
        status = run.status()
        state = status.state if status else "unreadable"
        return row | {"state": state} | (run.results() if state == "finished" else {})
    except RunError as error:
        return row | {"state": "unreadable", "error": str(error)}

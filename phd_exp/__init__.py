"""Probabilistic 3-D position estimation from a single camera with the Projected Huber distribution."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from phd_exp.inference.predictor import Predictor
    from phd_exp.inference.trained import TrainedRun

__version__ = "0.1.0"

# Each function imports what it needs: importing phd_exp alone takes no torch.


def train(overrides: Sequence[str] = (), config_dir: str | Path | None = None) -> TrainedRun:
    """Train a run as `python -m phd_exp` does with these overrides, or find it finished.

    Args:
        overrides: such as `["model=mae_logz", "data=scale", "preset=small"]`.
        config_dir: a folder with further choices, like --config-dir.

    Raises UserError, also without the extra `train`, or an error of a custom part.
    """
    from phd_exp.records.errors import ConfigError, install

    try:
        from phd_exp.cli.train import trained
    except ModuleNotFoundError as error:
        raise ConfigError(f"{error}{install(error.name or '')}") from None
    return trained(overrides, config_dir)


def load(
    run: str | Path | Sequence[str | Path],
    device: str = "auto",
    recalibrate: bool = False,
    trust: tuple[str, ...] = (),
    views: int = 1,
    margin: float = 1.0,
) -> Predictor:
    """A trained run or an ensemble as a callable from images to predictions; see `inference.loading.load`."""
    from phd_exp.inference import loading

    return loading.load(run, device, recalibrate, trust, views, margin)


def runs(folder: str | Path = "runs") -> Any:
    """All runs under a folder as a table; see `phd_exp.inference.trained.runs_table`."""
    from phd_exp.inference.trained import runs_table

    return runs_table(Path(folder))


def measured(folder: str | Path = "runs", report: str | Path = "report") -> Any:
    """Every number of all runs under a folder, one row each, as a DataFrame; see `phd_exp.reports.numbers.COLUMNS`.

    Measurements that `python -m phd_exp report` has stored in the folder `report` are not repeated. Raises UserError
    without the extra `report`.
    """
    from phd_exp.records.errors import UserError

    try:
        from phd_exp.reports.report import measured
    except ModuleNotFoundError as error:
        raise UserError(f"{error}; `pip install 'phd_exp[report]'`") from None
    return measured(Path(folder), Path(report) / "measured")

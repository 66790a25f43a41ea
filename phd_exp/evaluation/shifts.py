"""Measures a run's predictions of its test samples at home and under shifts."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from phd_exp.evaluation.conformal import level_threshold
from phd_exp.evaluation.familiar import ALARM, Familiarity
from phd_exp.evaluation.parquet import Arrays, read_table
from phd_exp.evaluation.predictions import ERRORS, finite_columns, inside, scalar_bands
from phd_exp.metrics.bootstrap import Interval, means
from phd_exp.metrics.calibration_scores import COLUMNS, calibration_scores, ordered
from phd_exp.records.errors import RunError, one_line
from phd_exp.records.runs import UNSHIFTED

MEASURED = (*COLUMNS, *ERRORS, "nll")


@dataclass(frozen=True)
class ShiftScores:
    """The scores of n samples; `left_out` further samples had values that are not finite.

    Attributes:
        change: the shift in words; empty at home.
        scores: means of `MEASURED`, the `calibration_scores`, and the per cent of truths inside credible regions:
            `inside_50`, `inside_90`, `inside_99`; with enough held-out samples also `inside_conformal`, the per cent
            `unfamiliar` with a p-value below `familiar.ALARM`, and `auroc`, of the distance against that at home.
    """

    change: str
    n: int
    left_out: int
    scores: dict[str, Interval[float]]


def shift_scores(folder: Path, home: Arrays, held_out: Arrays | None) -> dict[str, ShiftScores]:
    """Name of each shift in a folder -> its scores, and those at `home`; empty without a shift, or for points.

    Raises RunError if a table cannot be read or lacks a column.
    """
    found, levels, rated = {}, {"50": 0.5, "90": 0.9, "99": 0.99}, _unrated
    if held_out and "level" in held_out:
        with suppress(RunError):  # too few samples
            levels["conformal"] = level_threshold(held_out, 0.9)
            familiarity = Familiarity(held_out)
            rated = partial(_rated, familiarity, np.sort(familiarity.distance(home)))
    for file in sorted(folder.glob("*.parquet")) if "level" in home else ():
        table, said = read_table(file), pq.read_schema(file).metadata or {}
        change = one_line(said.get(b"shift", b"").decode(errors="replace"))
        found[file.stem] = _scores(table, levels, rated(table), change)
    return found | {UNSHIFTED: _scores(home, levels, rated(home))} if found else {}


def _unrated(table: Arrays) -> Arrays:
    return {}


def _rated(familiarity: Familiarity, usual: np.ndarray, table: Arrays) -> Arrays:
    """Whether each sample is unfamiliar (per cent), and the share of `usual` distances, at home, that are smaller."""
    distance = familiarity.distance(table)
    below = sum(np.searchsorted(usual, distance, side) for side in ("left", "right"))  # ties count half
    unfamiliar = 100.0 * (familiarity.p_value(distance) < ALARM)
    return {"unfamiliar": unfamiliar, "auroc": np.asarray(below / (2 * len(usual)))}


def _scores(table: Arrays, levels: Mapping[str, float], rated: Arrays, change: str = "") -> ShiftScores:
    columns, finite = finite_columns({**table, **rated}, (*MEASURED, *rated))
    columns |= {f"inside_{name}": inside(columns["level"], level) for name, level in levels.items()}
    scores = scalar_bands(
        lambda part, counts: means(part, counts) | calibration_scores(ordered(part, counts)), columns
    )
    return ShiftScores(change, int(finite.sum()), int((~finite).sum()), scores)

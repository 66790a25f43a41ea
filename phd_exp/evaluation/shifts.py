"""Measures a run's predictions of shifted test samples."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from phd_exp.evaluation.parquet import Columns, read_table
from phd_exp.evaluation.predictions import scores
from phd_exp.evaluation.reference import Band
from phd_exp.records.errors import one_line

LEVELS = (50, 90, 99)
"""Credible levels whose coverage is measured, per cent."""


@dataclass(frozen=True)
class ShiftScores:
    """The scores of n samples; `left_out` further samples had values that are not finite.

    Attributes:
        change: the change of the samples in words; empty for the unchanged ones.
        scores: those of an `Evaluation`, and the coverage in per cent: `inside_50`, `inside_90`, `inside_99` of the
            credible regions, `inside_conformal` of the conformal 90 % region, if there are held-out samples.
    """

    change: str
    n: int
    left_out: int
    scores: dict[str, Band]


def shift_scores(table: Columns, held_out: Columns | None, change: str = "") -> ShiftScores:
    """The scores of a table of predictions. Raises RunError if a column is missing, or no sample is finite."""
    regions = {f"inside_{level}": level / 100 for level in LEVELS}
    if held_out and (threshold := conformal_threshold(held_out, 0.9)) is not None:
        regions["inside_conformal"] = threshold
    found, left_out = scores(table, regions)
    return ShiftScores(change, len(table["x"]) - left_out, left_out, found)


def read_shift(file: Path, held_out: Columns | None) -> ShiftScores:
    """The scores of a recorded table. Raises RunError if it cannot be read."""
    table = read_table(file)  # checks the file
    said = pq.read_schema(file).metadata or {}
    return shift_scores(table, held_out, one_line(said.get(b"shift", b"").decode(errors="replace")))


def conformal_threshold(held_out: Columns, coverage: float) -> float | None:
    """The level whose credible regions contain new truths of the same distribution with at least this probability.

    It is the ceil((n + 1) coverage)-th smallest level of the n odd rows of the held-out samples; None if n is too
    small, or if the predictions have no level.
    """
    levels = np.sort(held_out.get("level", np.empty(0))[1::2])
    rank = math.ceil((len(levels) + 1) * coverage)
    return float(levels[rank - 1]) if rank <= len(levels) else None

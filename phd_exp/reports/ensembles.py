"""Ensembles of seeds, and of the eight symmetric views of each image, measured from the records of single runs."""

from collections.abc import Sequence
from functools import partial
from itertools import groupby
from pathlib import Path

import pandas as pd
import torch
from pydantic import TypeAdapter
from torch import Tensor

from phd_exp.evaluation.parquet import Arrays, read_table
from phd_exp.evaluation.predictions import ensemble_table, inside, scalar_bands
from phd_exp.metrics.bootstrap import Interval, means
from phd_exp.reports.measured import Notes, stored
from phd_exp.reports.numbers import SAME
from phd_exp.reports.runs import Run
from phd_exp.reports.table import file_stem

SIZES = (2, 3, 5)
SCORES = ("nll", "inside_90", "level")
Scores = dict[str, tuple[dict[str, Interval[float]], int]]
"""Kind of prediction -> its scores, and the number of test samples."""
_ADAPTER: TypeAdapter[Scores] = TypeAdapter(Scores)


def ensemble_scores(every: Sequence[Run], notes: Notes, kept: Path | None) -> pd.DataFrame:
    """The scores of each configuration with two seeds of a density, or with a record of eight views.

    The columns are those of `numbers.SAME`, `value`, `low`, `high` and `n`; the method is the kind of prediction. The
    folder `kept`, if given, stores the scores until a run changes.
    """
    rows = []
    densities = sorted((run for run in every if run.nll is not None), key=_configuration)
    for key, alike in groupby(densities, key=_configuration):
        runs = list(alike)
        found = notes.attempt(partial(_stored, runs, kept), f"ensembles of {'/'.join(key)}: ") or {}
        rows += [
            [*key, runs[0].overrides or "", "whole", "test", name, kind, band.value, band.low, band.high, n]
            for kind, (scores, n) in found.items()
            for name, band in scores.items()
        ]
    return pd.DataFrame(rows, columns=[*SAME, "value", "low", "high", "n"])


def _configuration(run: Run) -> tuple[str, str, str, str]:
    return run.preset, run.data, run.model, run.digest


def _stored(runs: Sequence[Run], kept: Path | None) -> Scores:
    if kept is None:
        return _scores(runs)
    sources = [file for run in runs for file in (run.folder.predictions, run.folder.eight_views["test"])]
    stem = file_stem("ensemble", *runs[0].folder.names[:3], runs[0].digest)
    return stored(kept / f"{stem}.json", sources, _ADAPTER, partial(_scores, runs))


def _scores(runs: Sequence[Run]) -> Scores:
    """The scores; empty without an ensemble, and for densities of other shapes."""
    eight = {run.name.partition("-")[0]: run.folder.eight_views["test"] for run in runs}
    eight = {seed: file for seed, file in eight.items() if file.exists()}
    if len(runs) < 2 and not eight:
        return {}
    seeds = [read_table(run.folder.predictions) for run in runs]
    if not all("a" in table for table in seeds):
        return {}
    tables = {f"{k} seeds": ensemble_table(seeds[:k]) for k in SIZES if k <= len(seeds)}
    tables |= {f"eight views, {seed}": read_table(file) for seed, file in eight.items()}
    one = [_columns(table) for table in seeds]
    columns = {"one network": {name: torch.stack([seed[name] for seed in one]).mean(0) for name in SCORES}}
    columns |= {kind: _columns(table) for kind, table in tables.items()}
    return {kind: (scalar_bands(means, of), len(of["nll"])) for kind, of in columns.items()}


def _columns(table: Arrays) -> dict[str, Tensor]:
    nll, level = torch.from_numpy(table["nll"]), torch.from_numpy(table["level"])
    return {"nll": nll, "inside_90": inside(level, 0.9), "level": level}

"""Ensembles of seeds, and of the eight symmetric views of each image, as a table from the records of single runs."""

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import groupby

import torch
from torch import Tensor

from phd_exp.evaluation.ensembles import ensemble_table
from phd_exp.evaluation.parquet import Columns, read_table
from phd_exp.evaluation.point_errors import SEED
from phd_exp.evaluation.predictions import band_of
from phd_exp.evaluation.reference import Band
from phd_exp.metrics.bootstrap import bands, means
from phd_exp.records.choices import in_words
from phd_exp.reports.measured import Notes
from phd_exp.reports.runs import Report, Run
from phd_exp.reports.table import Table, TableCell, TableRow, file_stem

SIZES = (2, 3, 5)
SCORES = {"nll": ("NLL (nats)", "{:.2f}"), "inside_90": ("inside 90 %", "{:.1f}"), "level": ("mean level", "{:.3f}")}
RESAMPLES = 200
OF_A_LINE = (
    "One network: the mean over the seeds. Seeds: the Projected Huber distribution closest to the mixture of the "
    "first ones; eight views: the same for one network's predictions of turned and mirrored images. Inside 90 %: per "
    "cent of true positions in the 90 % region; mean level: 0.5 if calibrated, more if overconfident. In brackets: "
    "95 % bootstrap intervals over test images."
)


def ensemble_tables(report: Report) -> list[Table]:
    """A table for every preset with two seeds of one configuration, or with a record of eight views."""
    tables = []
    for preset in report.presets:
        runs = [run for run in report.runs if run.preset == preset and run.measured.before and run.nll is not None]
        found = {
            f"{alike[0].title}{' ' * bool(name[2])}{name[2]}": scores
            for name, same in groupby(sorted(runs, key=_configuration), key=_configuration)
            if (alike := list(same)) and (scores := Notes().attempt(partial(_scores, alike)))
        }
        if found:
            tables.append(_table(preset, found))
    return tables


def _configuration(run: Run) -> tuple[str, str, str]:
    return run.data, run.model, run.name.partition("-")[2]


def _scores(runs: Sequence[Run]) -> dict[str, dict[str, Band]]:
    """Kind of ensemble -> its scores; empty without an ensemble."""
    seeds = [read_table(run.folder.predictions) for run in runs]
    tables = {f"{k} seeds": ensemble_table(seeds[:k]) for k in SIZES if k <= len(seeds)}
    for run in runs:
        if (file := run.folder.eight_views["test"]).exists():
            tables[f"eight views, {run.name}"] = read_table(file)
    if not tables:
        return {}
    one = [_columns(seed) for seed in seeds]
    columns = {"one network": {name: torch.stack([seed[name] for seed in one]).mean(0) for name in SCORES}}
    columns |= {kind: _columns(table) for kind, table in tables.items()}
    found = {kind: bands(means, of, RESAMPLES, SEED) for kind, of in columns.items()}
    return {kind: {name: band_of(band) for name, band in of.items()} for kind, of in found.items()}


def _columns(table: Columns) -> dict[str, Tensor]:
    nll, level = torch.from_numpy(table["nll"]), torch.from_numpy(table["level"])
    return {"nll": nll, "inside_90": 100.0 * (level <= 0.9), "level": level}


def _table(preset: str, found: Mapping[str, Mapping[str, Mapping[str, Band]]]) -> Table:
    return Table(
        stem=file_stem("ensembles", preset),
        kind="ensembles",
        title=f"Ensembles, {in_words(preset)}: scores on the test samples",
        stub=("runs", "prediction"),
        columns=tuple(label for label, _ in SCORES.values()),
        groups=tuple(tuple(_row(runs, *kind) for kind in of.items()) for runs, of in found.items()),
        notes=(OF_A_LINE,),
        preset=preset,
        numbers=tuple(
            {"preset": preset, "runs": runs, "prediction": kind, "quantity": name} | vars(band)
            for runs, of in found.items()
            for kind, scores in of.items()
            for name, band in scores.items()
        ),
    )


def _row(runs: str, kind: str, scores: Mapping[str, Band]) -> TableRow:
    cells = []
    for name, (_, form) in SCORES.items():
        value, low, high = (form.format(number) for number in vars(scores[name]).values())
        cells.append(TableCell(value, f"({low} to {high})"))
    return TableRow((runs, kind), tuple(cells))

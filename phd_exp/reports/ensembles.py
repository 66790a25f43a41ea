"""Ensembles of seeds, and of the eight symmetric views of each image, as a table from the records of single runs."""

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import groupby, starmap

import torch
from torch import Tensor

from phd_exp.evaluation.parquet import Columns, read_table
from phd_exp.evaluation.predictions import ensemble_table, inside, scalar_bands
from phd_exp.metrics.bootstrap import Interval, means
from phd_exp.records.choices import in_words
from phd_exp.reports.runs import Report, Run
from phd_exp.reports.table import Table, TableCell, TableRow, file_stem

SIZES = (2, 3, 5)
SCORES = {"nll": ("NLL (nats)", "{:.2f}"), "inside_90": ("inside 90 %", "{:.1f}"), "level": ("mean level", "{:.3f}")}
OF_A_LINE = (
    "One network: the mean over the seeds. Seeds: the Projected Huber distribution closest to the mixture of the "
    "first ones; eight views: the same for one network's predictions of turned and mirrored images. Inside 90 %: per "
    "cent of true positions in the 90 % region; mean level: 0.5 if calibrated, more if overconfident. In brackets: "
    "95 % bootstrap intervals over test images."
)


def ensemble_tables(report: Report) -> list[Table]:
    """A table for every preset with two seeds of one configuration, or with a record of eight views."""
    configurations = groupby(sorted(report.runs, key=_configuration), key=_configuration)
    attempt = report.notes.attempt
    scored = [
        (named, attempt(partial(_scores, list(runs)), f"ensembles of {'/'.join(named)}: "))
        for named, runs in configurations
    ]
    return [
        Table(
            stem=file_stem("ensembles", preset),
            kind="ensembles",
            title=f"Ensembles, {in_words(preset)}: scores on the test samples",
            stub=("runs", "prediction"),
            columns=tuple(label for label, _ in SCORES.values()),
            groups=tuple(
                tuple(
                    TableRow((f"{model} on {data} {hashed}".rstrip(), kind), tuple(starmap(_cell, scores.items())))
                    for kind, scores in kinds.items()
                )
                for (_, data, model, hashed), kinds in found
            ),
            notes=(OF_A_LINE,),
            preset=preset,
            numbers=tuple(
                {"preset": preset, "data": data, "model": model, "overrides": hashed, "prediction": kind}
                | {"quantity": name}
                | vars(band)
                for (_, data, model, hashed), kinds in found
                for kind, scores in kinds.items()
                for name, band in scores.items()
            ),
        )
        for preset in report.presets
        if (found := [(named, kinds) for named, kinds in scored if kinds and named[0] == preset])
    ]


def _configuration(run: Run) -> tuple[str, str, str, str]:
    return run.preset, run.data, run.model, run.digest


def _scores(runs: Sequence[Run]) -> dict[str, Mapping[str, Interval[float]]]:
    """Kind of prediction -> its scores; empty without an ensemble."""
    runs = [run for run in runs if run.nll is not None]
    seeds = [read_table(run.folder.predictions) for run in runs]
    tables = {f"{k} seeds": ensemble_table(seeds[:k]) for k in SIZES if k <= len(seeds)}
    eight = {run.name.partition("-")[0]: run.folder.eight_views["test"] for run in runs}
    tables |= {f"eight views, {seed}": read_table(file) for seed, file in eight.items() if file.exists()}
    if not tables:
        return {}
    one = [_columns(table) for table in seeds]
    columns = {"one network": {name: torch.stack([seed[name] for seed in one]).mean(0) for name in SCORES}}
    columns |= {kind: _columns(table) for kind, table in tables.items()}
    return {kind: scalar_bands(means, of) for kind, of in columns.items()}


def _columns(table: Columns) -> dict[str, Tensor]:
    nll, level = torch.from_numpy(table["nll"]), torch.from_numpy(table["level"])
    return {"nll": nll, "inside_90": inside(level, 0.9), "level": level}


def _cell(name: str, band: Interval[float]) -> TableCell:
    text = band.each(SCORES[name][1].format)
    return TableCell(text.value, f"({text.low} to {text.high})")

"""Ensembles of seeds, and of the eight symmetric views of each image, as a table from the records of single runs."""

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import groupby

import torch
from torch import Tensor

from phd_exp.evaluation.parquet import Arrays, read_table
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
    configurations = [list(runs) for _, runs in groupby(sorted(report.runs, key=_configuration), key=_configuration)]
    attempt = report.notes.attempt
    scored = [
        (runs[0], attempt(partial(_scores, runs), f"ensembles of {'/'.join(_configuration(runs[0]))}: "))
        for runs in configurations
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
                    TableRow((f"{run.model} on {run.data} {run.digest}".rstrip(), kind), _cells(run, kind, scores))
                    for kind, scores in kinds.items()
                )
                for run, kinds in found
            ),
            notes=(OF_A_LINE,),
            preset=preset,
        )
        for preset in report.presets
        if (found := [(run, kinds) for run, kinds in scored if kinds and run.preset == preset])
    ]


def _configuration(run: Run) -> tuple[str, str, str, str]:
    return run.preset, run.data, run.model, run.digest


def _scores(runs: Sequence[Run]) -> dict[str, Mapping[str, Interval[float]]]:
    """Kind of prediction -> its scores; empty without an ensemble, and for densities of other shapes."""
    runs = [run for run in runs if run.nll is not None]
    seeds = [read_table(run.folder.predictions) for run in runs]
    if not all("a" in table for table in seeds):
        return {}
    tables = {f"{k} seeds": ensemble_table(seeds[:k]) for k in SIZES if k <= len(seeds)}
    eight = {run.name.partition("-")[0]: run.folder.eight_views["test"] for run in runs}
    tables |= {f"eight views, {seed}": read_table(file) for seed, file in eight.items() if file.exists()}
    if not tables:
        return {}
    one = [_columns(table) for table in seeds]
    columns = {"one network": {name: torch.stack([seed[name] for seed in one]).mean(0) for name in SCORES}}
    columns |= {kind: _columns(table) for kind, table in tables.items()}
    return {kind: scalar_bands(means, of) for kind, of in columns.items()}


def _columns(table: Arrays) -> dict[str, Tensor]:
    nll, level = torch.from_numpy(table["nll"]), torch.from_numpy(table["level"])
    return {"nll": nll, "inside_90": inside(level, 0.9), "level": level}


def _cells(run: Run, kind: str, scores: Mapping[str, Interval[float]]) -> tuple[TableCell, ...]:
    cells, key = [], run.choice | {"overrides": run.digest, "prediction": kind}
    for name, band in scores.items():
        text, line = band.each(SCORES[name][1].format), key | {"quantity": name} | vars(band)
        cells.append(TableCell(text.value, f"({text.low} to {text.high})", numbers=(line,)))
    return tuple(cells)

"""Predictions of a run from the eight symmetric views of each image: `eight_views_*.parquet` in its folder."""

import torch

from phd_exp.data.sources import PARTS, Source
from phd_exp.inference.predictor import BATCH, load
from phd_exp.metrics.rows import Rows
from phd_exp.records.runs import RunFolder
from phd_exp.training.predictions import columns, summary, write_parquet


def record_eight_views(folder: RunFolder, source: Source) -> None:
    """Predict the held-out and test samples of a finished run, from its source, and record them, once.

    The files have the columns of `predictions.parquet`, of the distribution closest to the mixture, and
    `disagreement`. results.json gets the means over test samples, as `eight_views/nll`.

    Raises RunError if another process holds the run or it has no checkpoint.
    """
    with folder.held():
        if folder.eight_views["test"].exists():
            return
        predictor = load(folder.path, trust=None, views=8)  # the user has just trained it
        for part in PARTS[1:]:
            if n := source.count(part):
                table, samples = Rows(), source.samples(part)
                for rows in torch.arange(n).split(BATCH):
                    batch = samples.select(rows)
                    mixture = predictor.members(predictor.raw(batch.image.numpy(), batch.f), batch.f)
                    table.update(columns(mixture.closest, batch) | {"disagreement": mixture.disagreement})
                write_parquet(folder.eight_views[part], table.columns(), source.known(part))
        folder.write_results(folder.results() | summary(table.columns(), "eight_views"))

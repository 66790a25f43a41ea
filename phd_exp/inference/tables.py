"""Tables of predictions of a finished run, which record their origin: an up-to-date table is not made again."""

from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import torch

from phd_exp.data.augmentation import Photometry
from phd_exp.data.batches import Batch
from phd_exp.distributions.columns import Columns
from phd_exp.inference.predictor import BATCH, Predictor
from phd_exp.metrics.rows import Rows
from phd_exp.records.runs import RunFolder
from phd_exp.training.predictions import columns

UNCHANGED = Photometry()


def predicted(predictor: Predictor, samples: Batch, change: Photometry = UNCHANGED, f_factor: float = 1.0) -> Columns:
    """The columns of `predictions.parquet` for these samples.

    The network receives their images with this fixed change, and `f_factor` times their focal lengths.
    """
    table = Rows()
    for rows in torch.arange(len(samples)).split(BATCH):
        part = samples.select(rows)
        f = f_factor * part.f
        table.update(columns(predictor.predict(predictor.raw(change.fixed(part.image).numpy(), f), f), part))
    return table.columns()


def origin_of(folder: RunFolder, **choices: Any) -> dict[str, str]:
    """The metadata of a table: the choices that made it, and the start of its run."""
    status = folder.status()
    origin = choices | {"run": "" if status is None else status.started}
    return {key: str(value) for key, value in origin.items()}


def is_table_of(file: Path, origin: dict[str, str]) -> bool:
    """Whether a file is a table with this origin."""
    try:
        found = pq.read_schema(file).metadata or {}
    except (OSError, pa.ArrowException):
        return False
    return all(found.get(key.encode()) == value.encode() for key, value in origin.items())

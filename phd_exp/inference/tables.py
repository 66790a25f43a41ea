"""Tables of a finished run's predictions. They record their origin, so that an up-to-date table is not made again."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import torch

from phd_exp.data.augmentation import Photometry
from phd_exp.data.sources import Known, Source
from phd_exp.inference.predictor import BATCH, load
from phd_exp.metrics.rows import Rows
from phd_exp.records.choices import flatten
from phd_exp.records.runs import RunFolder
from phd_exp.training.config import RenderedConfig, RunConfig
from phd_exp.training.config.sections import ShiftConfig
from phd_exp.training.predictions import columns, write_parquet


def record(
    folder: RunFolder, file: Path, source: Source, origin: Mapping[str, str], more: Known, shift: ShiftConfig
) -> None:
    """Predict the test samples of a source, with the changes of a shift, and write them with `more` columns.

    Raises RunError if another process holds the run or it has no checkpoint, DatasetError if a sample is missing.
    """
    change, table = Photometry(**dict[str, Any](**shift.images)), Rows()
    with folder.held():
        predictor, samples = load(folder.path, trust=None), source.samples("test")  # the user has just trained it
        for rows in torch.arange(len(samples)).split(BATCH):
            part = samples.select(rows)
            f = shift.f_factor * part.f
            table.update(columns(predictor.predict(predictor.raw(change.fixed(part.image).numpy(), f), f), part))
        file.parent.mkdir(exist_ok=True)
        write_parquet(file, table.columns(), {**source.known("test"), **more}, origin)


def origin_of(folder: RunFolder, **choices: Any) -> dict[str, str]:
    """The metadata of a table: the choices that made it, and the start of its run."""
    status = folder.status()
    return {key: str(value) for key, value in choices.items()} | {
        "run": "" if status is None else str(status.started)
    }


def origin_of_shift(folder: RunFolder, config: RunConfig, name: str) -> dict[str, str]:
    """The metadata of a shift's table."""
    changes, data = flatten(config.evaluation.shifts[name].model_dump(exclude_defaults=True)), config.data_of(name)
    samples = f"{data.spec.fingerprint()}, {data.n_test}" if isinstance(data, RenderedConfig) else data.name
    return origin_of(folder, shift=", ".join(f"{key}={value}" for key, value in changes.items()), data=samples)


def is_recorded(file: Path, origin: Mapping[str, str]) -> bool:
    """Whether a file is a table with this origin."""
    try:
        found = pq.read_schema(file).metadata or {}
    except (OSError, pa.ArrowException):
        return False
    return all(found.get(key.encode()) == value.encode() for key, value in origin.items())

"""Predictions of a run for shifted test samples: `shifts/NAME.parquet` in its folder."""

import torch

from phd_exp.data.augmentation import Photometry
from phd_exp.data.sources import Source
from phd_exp.inference.predictor import load
from phd_exp.inference.tables import is_table_of, origin_of, predicted
from phd_exp.records.choices import flatten
from phd_exp.records.runs import RunFolder
from phd_exp.training.config import RenderedConfig, RunConfig
from phd_exp.training.predictions import write_parquet


def record_shift(folder: RunFolder, config: RunConfig, name: str, source: Source) -> None:
    """Predict the samples of a shift and record them: the columns of `predictions.parquet`, in the same order.

    The run is finished; `source` has the test samples before the change.

    Raises RunError if another process holds the run or it has no checkpoint, DatasetError if a sample is missing.
    """
    shift, n = config.evaluation.shifts[name], config.evaluation.n_shifted
    with folder.held():
        predictor = load(folder.path, trust=None)  # the user has just trained it
        samples = source.samples("test")
        samples = samples.select(torch.arange(len(samples))[:n])
        table = predicted(predictor, samples, Photometry(**shift.images.model_dump()), shift.f_factor)
        folder.shifts.mkdir(exist_ok=True)
        write_parquet(folder.shift(name), table, source.known("test"), _origin(folder, config, name))


def is_recorded(folder: RunFolder, config: RunConfig, name: str) -> bool:
    """Whether the record exists, of exactly this shift, these samples and this run."""
    return is_table_of(folder.shift(name), _origin(folder, config, name))


def _origin(folder: RunFolder, config: RunConfig, name: str) -> dict[str, str]:
    changes = flatten(config.evaluation.shifts[name].model_dump(mode="json", exclude_defaults=True))
    data = config.data_of(name)
    return origin_of(
        folder,
        shift=", ".join(f"{key}={value}" for key, value in changes.items()),
        data=data.spec.fingerprint() if isinstance(data, RenderedConfig) else data.name,
        n=config.evaluation.n_shifted or data.n_test,
    )

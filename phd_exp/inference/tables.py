"""Further tables of a finished run: predictions of shifted samples, of several views and of turned images.

Shifts and several views record their origin, so that an up-to-date table is not made again.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import torch

from phd_exp.data.augmentation import Photometry
from phd_exp.data.sources import PARTS, Known, Part, RenderedSource, Source
from phd_exp.distributions.columns import Columns
from phd_exp.evaluation.several_views import ROTATION, TRANSLATION
from phd_exp.inference.loading import load
from phd_exp.inference.predictor import BATCH
from phd_exp.metrics.rows import Rows
from phd_exp.records.choices import flatten
from phd_exp.records.runs import RunFolder
from phd_exp.training.config import RenderedConfig, RunConfig
from phd_exp.training.config.sections import ShiftConfig
from phd_exp.training.predictions import columns, summary, write_parquet

UNCHANGED = ShiftConfig()


def record(
    folder: RunFolder, file: Path, source: Source, origin: Mapping[str, str], shift: ShiftConfig = UNCHANGED
) -> None:
    """Predict the test samples of a source, with the changes of a shift, and write them.

    Of several views, the table also has the pose of each. Raises RunError if another process holds the run or it has
    no checkpoint, DatasetError if a sample is missing.
    """
    with folder.held():
        table, known = _predicted(folder, source, "test", shift), dict(source.known("test"))
        if shift.f_factor != 1:  # the table has the focal length that the network received
            known = {name: values for name, values in known.items() if name not in ("f", "S")}
        if file == folder.views and isinstance(source, RenderedSource):
            known |= _poses(source)
        file.parent.mkdir(exist_ok=True)
        write_parquet(file, table, known, origin)


def record_eight_views(folder: RunFolder, source: Source) -> None:
    """Predict the eight symmetric views of each held-out and test sample of a run's own source, once.

    The files have the columns of `predictions.parquet`, of the distribution closest to the mixture, and
    `disagreement`. results.json gets the means over test samples, as `eight_views/nll`. Raises as `record`.
    """
    with folder.held():
        if folder.eight_views["test"].exists():
            return
        for part in PARTS[1:]:
            if source.count(part):
                table = _predicted(folder, source, part, views=8)
                write_parquet(folder.eight_views[part], table, source.known(part))
        folder.write_results(folder.results() | summary(table, "eight_views"))


def _poses(source: RenderedSource) -> Known:
    """The pose of the camera of each test sample."""
    poses = [sample.pose for sample in source.folder.records("test", source.count("test"))]
    numbers = zip(*((*pose.rotation, *pose.translation) for pose in poses), strict=True)
    return dict(zip((*ROTATION, *TRANSLATION), map(list, numbers), strict=True))


def _predicted(
    folder: RunFolder, source: Source, part: Part, shift: ShiftConfig = UNCHANGED, views: int = 1
) -> Columns:
    """The run's predictions of a part of the samples; of several symmetric views also their `disagreement`."""
    predictor, samples = load(folder.path, trust=None, views=views), source.samples(part)  # the user has trained it
    change, table = Photometry(**dict[str, Any](**shift.images)), Rows()
    for rows in torch.arange(len(samples)).split(BATCH):
        batch = samples.select(rows)
        f = shift.f_factor * batch.f
        raw = predictor.raw(change.fixed(batch.image).numpy(), f)
        found = columns(predictor.predict(raw, f), replace(batch, f=f))
        if predictor.is_ensemble:
            found["disagreement"] = predictor.members(raw, f).disagreement
        table.update(found)
    return table.columns()


def origin_of(folder: RunFolder, **choices: Any) -> dict[str, str]:
    """The metadata of a table: the choices that made it, and the start of its run."""
    status = folder.status()
    return {key: str(value) for key, value in choices.items()} | {"run": str(status.started) if status else ""}


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

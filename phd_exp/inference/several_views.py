"""Predictions of a run for each view of scenes with several cameras: `views.parquet` in its folder."""

import pyarrow as pa
import pyarrow.parquet as pq
import torch

from phd_exp.data.sources import RenderedSource
from phd_exp.evaluation.several_views import ROTATION, TRANSLATION
from phd_exp.inference.predictor import BATCH, load
from phd_exp.metrics.rows import Rows
from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.runs import RunFolder
from phd_exp.records.spec import DatasetSpec
from phd_exp.training.predictions import columns, write_parquet


def record_views(folder: RunFolder, data: DatasetFolder, spec: DatasetSpec, scenes: int) -> bool:
    """Predict every view of the first test scenes and record them. Returns False if they were recorded already.

    The file has a row for each view, with the columns of `predictions.parquet`, `scene`, `view` and the pose. The run
    is finished; `spec` is that of its own data set, except for the number of views.

    Raises RunError if another process holds the run or it has no checkpoint, DatasetError if the data set is another
    one or lacks a sample.
    """
    origin = _origin(spec, scenes, folder)
    with folder.held():
        if is_recorded(folder, spec, scenes):
            return False
        data.require(spec)
        predictor = load(folder.path, trust=None)  # the user has just trained it
        n = scenes * spec.views
        source = RenderedSource(data, spec, {"train": 0, "held_out": 0, "test": n}, predictor.side)
        samples = source.samples("test")
        table = Rows()
        for rows in torch.arange(n).split(BATCH):
            part = samples.select(rows)
            table.update(columns(predictor.predict(predictor.raw(part.image.numpy(), part.f), part.f), part))
        poses = [(*record.pose.rotation, *record.pose.translation) for record in data.records("test", n)]
        pose_columns = zip((*ROTATION, *TRANSLATION), map(list, zip(*poses, strict=True)), strict=True)
        known = dict(source.known("test")) | dict(pose_columns)
        write_parquet(folder.views, table.columns(), known, origin)
    return True


def is_recorded(folder: RunFolder, spec: DatasetSpec, scenes: int) -> bool:
    """Whether the record exists, for exactly these scenes and this run."""
    try:
        found = pq.read_schema(folder.views).metadata or {}
    except (OSError, pa.ArrowException):
        return False
    wanted = _origin(spec, scenes, folder).items()
    return all(found.get(key.encode()) == value.encode() for key, value in wanted)


def _origin(spec: DatasetSpec, scenes: int, folder: RunFolder) -> dict[str, str]:
    """The data, the number of scenes and the run of a record."""
    status = folder.status()
    started = "" if status is None else str(status.started)
    return {"data": spec.fingerprint(), "scenes": str(scenes), "run": started}

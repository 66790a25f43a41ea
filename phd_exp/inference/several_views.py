"""What a run says of each view of scenes that several cameras see: `views.parquet` in its folder."""

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
    """Predict every view of the first test scenes and record it; whether there was anything left to do.

    The file holds a row a view, as `predictions.parquet` has them, with `scene`, `view` and the pose.

    Args:
        folder: of a finished run.
        data: the folder of the data set.
        spec: its specification, that of the run's own data set but for the number of views.
        scenes: how many.

    Raises RunError where another process works on the run or it has no checkpoint, DatasetError where the data set is
    another one or lacks a sample.
    """
    said = _said(spec, scenes, folder)
    with folder.held():
        if is_recorded(folder, spec, scenes):
            return False
        data.require(spec)
        predictor = load(folder.path)
        n = scenes * spec.views
        source = RenderedSource(data, spec, {"train": 0, "held_out": 0, "test": n}, predictor.side)
        samples = source.samples("test")
        table = Rows()
        for rows in torch.arange(n).split(BATCH):
            part = samples.select(rows)
            table.update(columns(predictor.predict(predictor.raw(part.image.numpy(), part.f), part.f), part))
        poses = [(*record.pose.rotation, *record.pose.translation) for record in data.records("test", n)]
        known = dict(source.known("test")) | dict(
            zip((*ROTATION, *TRANSLATION), map(list, zip(*poses, strict=True)), strict=True)
        )
        write_parquet(folder.views, table.columns(), known, said)
    return True


def is_recorded(folder: RunFolder, spec: DatasetSpec, scenes: int) -> bool:
    """Whether the record of precisely these scenes is there, by this run and no other that was in its folder."""
    try:
        found = pq.read_schema(folder.views).metadata or {}
    except (OSError, pa.ArrowException):
        return False
    return all(
        found.get(key.encode()) == value.encode() for key, value in _said(spec, scenes, folder).items()
    )


def _said(spec: DatasetSpec, scenes: int, folder: RunFolder) -> dict[str, str]:
    """What a record was made of: another one is not it."""
    status = folder.status()
    return {
        "data": spec.fingerprint(),
        "scenes": str(scenes),
        "run": "" if status is None else str(status.started),
    }

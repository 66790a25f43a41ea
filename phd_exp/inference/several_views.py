"""Predictions of a run for each view of scenes with several cameras: `views.parquet` in its folder."""

from phd_exp.data.sources import RenderedSource
from phd_exp.evaluation.several_views import ROTATION, TRANSLATION
from phd_exp.inference.predictor import load
from phd_exp.inference.tables import is_table_of, origin_of, predicted
from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.runs import RunFolder
from phd_exp.records.spec import DatasetSpec
from phd_exp.training.predictions import write_parquet


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
        table = predicted(predictor, source.samples("test"))
        poses = [(*record.pose.rotation, *record.pose.translation) for record in data.records("test", n)]
        pose_columns = zip((*ROTATION, *TRANSLATION), map(list, zip(*poses, strict=True)), strict=True)
        known = dict(source.known("test")) | dict(pose_columns)
        write_parquet(folder.views, table, known, origin)
    return True


def is_recorded(folder: RunFolder, spec: DatasetSpec, scenes: int) -> bool:
    """Whether the record exists, for exactly these scenes and this run."""
    return is_table_of(folder.views, _origin(spec, scenes, folder))


def _origin(spec: DatasetSpec, scenes: int, folder: RunFolder) -> dict[str, str]:
    """The data, the number of scenes and the run of a record."""
    return origin_of(folder, data=spec.fingerprint(), scenes=scenes)

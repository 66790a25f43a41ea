"""Predictions of a run for each view of scenes with several cameras: `views.parquet` in its folder."""

from collections.abc import Mapping

from phd_exp.data.sources import RenderedSource
from phd_exp.evaluation.several_views import ROTATION, TRANSLATION
from phd_exp.inference.tables import record
from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.runs import RunFolder
from phd_exp.records.spec import DatasetSpec
from phd_exp.training.config.sections import ShiftConfig


def record_views(
    folder: RunFolder, data: DatasetFolder, spec: DatasetSpec, scenes: int, origin: Mapping[str, str]
) -> None:
    """Predict every view of the first test scenes and record them.

    The file has a row for each view, with the columns of `predictions.parquet`, `scene`, `view` and the pose. The run
    is finished; `spec` is that of its own data set, except for the number of views.

    Raises as `record`, and DatasetError if the data set is another one.
    """
    data.require(spec)
    n, side = scenes * spec.views, folder.config()["data"]["image_size"]
    source = RenderedSource(data, spec, {"train": 0, "held_out": 0, "test": n}, side)
    poses = [(*sample.pose.rotation, *sample.pose.translation) for sample in data.records("test", n)]
    more = dict(zip((*ROTATION, *TRANSLATION), map(list, zip(*poses, strict=True)), strict=True))
    record(folder, folder.views, source, origin, more, ShiftConfig())

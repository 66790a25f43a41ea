"""Further tables of a finished run: predictions of shifted samples, of several views and of turned images.

Each records its origin, so that an up-to-date table is not made again. The network receives the focal lengths that it
receives in the evaluations of its training, wrong ones with `camera.f_error`.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch

from phd_exp.config import RenderedConfig, RunConfig
from phd_exp.config.sections import ShiftConfig
from phd_exp.config.targets import Trust
from phd_exp.data.batches import Batch
from phd_exp.data.photometry import VERSION, Photometry
from phd_exp.data.sources import PARTS, Known, Part, RenderedSource, Source, blocks
from phd_exp.distributions.columns import Columns
from phd_exp.evaluation.parquet import read_table, stacked
from phd_exp.evaluation.predictions import XYZ
from phd_exp.evaluation.several_views import ROTATION, TRANSLATION
from phd_exp.inference.answers import sightings
from phd_exp.inference.loading import load
from phd_exp.inference.predictor import BATCH, Predictor
from phd_exp.records.choices import flatten
from phd_exp.records.detections import Detection
from phd_exp.records.errors import RunError
from phd_exp.records.files import make_folder
from phd_exp.records.processes import announce
from phd_exp.records.runs import RunFolder
from phd_exp.training.cameras import f_factor
from phd_exp.training.predictions import columns, summary, write_parquet

UNCHANGED = ShiftConfig()


def record(
    folder: RunFolder, file: Path, source: Source, origin: Mapping[str, str], shift: ShiftConfig = UNCHANGED
) -> None:
    """Predict the test samples of a source, with the changes of a shift, and write them.

    Of several views and of sequences, the table also has the pose of each, and the time. Raises RunError if another
    process holds the run or it has no checkpoint, DatasetError if a sample is missing.
    """
    predictor = load(folder.path, trust=None)  # the user has trained it
    with folder.held():
        table, known = _predicted(predictor, source, "test", shift), dict(source.known("test"))
        if isinstance(source, RenderedSource) and max(source.spec.views, source.spec.frames) > 1:
            known |= _poses_and_times(source)
        make_folder(file.parent)
        write_parquet(file, table, known, origin)


def record_eight_views(
    folder: RunFolder, config: RunConfig, source: Source, parts: Sequence[Part] = PARTS[1:], trust: Trust = None
) -> None:
    """Predict the eight symmetric views of each sample of a run's own source, once; of held-out and test samples.

    The files have the columns of `predictions.parquet`, of the distribution closest to the mixture, and
    `disagreement`. results.json gets the means over test samples, as `eight_views/nll`. Raises as `record`.
    """
    origin = of_camera(config)
    wanted = [part for part in parts if source.count(part) and not is_recorded(folder.eight_views[part], origin)]
    if not wanted:
        return
    predictor = load(folder.path, trust=trust, views=8)
    with folder.held():
        for part in wanted:
            table = _predicted(predictor, source, part)
            if part == "test":
                folder.write_results(folder.results() | summary(table, "eight_views"))
            write_parquet(folder.eight_views[part], table, source.known(part), origin)


def record_held_out_views(predictor: Predictor, source: Source, trust: Trust) -> None:
    """Record the eight views of a finished run's held-out samples. Raises RunError if they are others by now."""
    (folder,), part = predictor.folders, PARTS[1]
    before, now = read_table(folder.held_out), source.samples(part).xyz.double().numpy()
    if not np.array_equal(now, stacked(before, XYZ).numpy()):
        raise RunError(
            f"{folder.held_out}: its samples are not those of {predictor.config.data.name} now; train again"
        )
    announce(f"{folder.eight_views[part]}: recording the eight views of {len(now)} held-out samples, once")
    record_eight_views(folder, predictor.config, source, [part], trust)


def record_labelled(predictor: Predictor, detections: Sequence[Detection], name: str) -> Columns:
    """Predict the user's labelled images and write the table NAME of `calibrate`; returns its columns.

    Raises DatasetError if a label is missing or in millimetres, ConfigError for a baseline.
    """
    folder, parts, n = predictor.folders[0], list[Columns](), 0
    if predictor.is_ensemble or predictor.state != "finished":
        raise RunError(f"{folder.path}: expected a single run, which is finished")
    predictor.require_densities("calibrate needs")
    for batch in dict.fromkeys(sighting.batch for sighting in sightings(predictor, detections)):
        views = [view for _, _, view in batch.seen]
        xyz = [view.camera.to_virtual(np.array(one.position)) for one, _, view in batch.seen]
        samples = Batch(
            torch.from_numpy(np.stack([view.image for view in views])),
            torch.tensor(np.stack(xyz)),
            torch.tensor([view.camera.f for view in views]),
            float(predictor.side),
            torch.arange(n, n + len(views)),
        )
        parts.append(columns(batch.predictions, samples))
        n += len(views)
    found = _joined(parts)
    found["margin"] = torch.full_like(found["f"], predictor.margin)
    file = folder.labelled(name)
    with folder.held():
        make_folder(file.parent)
        lines = [one.line for one in detections]
        known = {"file_name": [line.file_name for line in lines], **blocks(lines)}
        write_parquet(file, found, known)
    return found


def _poses_and_times(source: RenderedSource) -> Known:
    """The pose of the camera of each test sample; of a sequence also its number and the time, seconds."""
    samples = source.folder.records("test", source.count("test"))
    numbers = zip(*((*sample.pose.rotation, *sample.pose.translation) for sample in samples), strict=True)
    known: dict[str, Any] = dict(zip((*ROTATION, *TRANSLATION), map(list, numbers), strict=True))
    if source.spec.frames > 1:
        known |= {
            "track": [int(sample.track or 0) for sample in samples],
            "time": [sample.time for sample in samples],
        }
    return known


def _predicted(predictor: Predictor, source: Source, part: Part, shift: ShiftConfig = UNCHANGED) -> Columns:
    """Predictions of a part of the samples; of several symmetric views also their `disagreement`."""
    samples, f_error = source.samples(part), predictor.config.camera.f_error
    change, parts = Photometry(**dict[str, Any](**shift.images)), list[Columns]()
    for rows in torch.arange(len(samples)).split(BATCH):
        batch = samples.select(rows)
        factor = shift.f_factor * f_factor(batch.row, f_error)
        f = factor * batch.f
        raw = predictor.raw(change.fixed(batch.image).numpy(), f)
        found = columns(predictor.predict(raw, f), batch, factor)
        if predictor.is_ensemble:
            found["disagreement"] = predictor.members(raw, f).disagreement
        parts.append(found)
    return _joined(parts)


def _joined(parts: Sequence[Columns]) -> Columns:
    """Tables one below the other."""
    return {name: torch.cat([part[name] for part in parts]).cpu() for name in parts[0]}


def of_camera(config: RunConfig) -> dict[str, str]:
    """The origin of the focal lengths that the network received; an earlier version always recorded exact ones."""
    return {"f_error": str(config.camera.f_error)} if config.camera.f_error else {}


def require_received(file: Path, config: RunConfig) -> None:
    """Raise RunError for a table of an earlier version with exact focal lengths, which makes it too certain."""
    if file.exists() and not is_recorded(file, of_camera(config)) and config.camera.f_error:
        raise RunError(
            f"{file}: recorded with exact focal lengths, but camera.f_error={config.camera.f_error}; repeat the "
            "command of the training, which records it again"
        )


def origin_of(folder: RunFolder, config: RunConfig, **choices: Any) -> dict[str, str]:
    """The metadata of a table: the choices that made it, and the start of its run."""
    status = folder.status()
    made = {key: str(value) for key, value in choices.items()} | {"run": str(status.started) if status else ""}
    return made | of_camera(config)


def origin_of_shift(folder: RunFolder, config: RunConfig, name: str) -> dict[str, str]:
    """The metadata of a shift's table; that of changed images has the version of the changes."""
    shift, data = config.evaluation.shifts[name], config.data_of(name)
    changes = flatten(shift.model_dump(exclude_defaults=True))
    samples = f"{data.spec.fingerprint()}, {data.n_test}" if isinstance(data, RenderedConfig) else data.name
    version = {"photometry": VERSION} if shift.images else {}
    words = ", ".join(f"{key}={value}" for key, value in changes.items())
    return origin_of(folder, config, shift=words, data=samples, **version)


def is_recorded(file: Path, origin: Mapping[str, str]) -> bool:
    """Whether a file is a table with this origin."""
    try:
        found = pq.read_schema(file).metadata or {}
    except (OSError, pa.ArrowException):
        return False
    return all(found.get(key.encode()) == value.encode() for key, value in origin.items())

"""Further tables of a finished run: several views, sequences, shifted samples and eight symmetric views.

Each records its origin, so that an up-to-date table is not made again. The network receives the focal lengths that it
receives in the evaluations of its training, wrong ones with `camera.f_error`.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from phd_exp.build import build_source, trained_network
from phd_exp.config import RenderedConfig, RunConfig
from phd_exp.config.sections import DataConfig, Render, ShiftConfig
from phd_exp.data.photometry import VERSION, Photometry
from phd_exp.data.sources import PARTS, Known, Part, RenderedSource, Source
from phd_exp.evaluation.parquet import read_table, stacked
from phd_exp.evaluation.predictions import XYZ
from phd_exp.evaluation.several_views import ROTATION, TRANSLATION
from phd_exp.records.choices import flatten
from phd_exp.records.errors import RunError
from phd_exp.records.files import make_folder
from phd_exp.records.processes import announce
from phd_exp.records.runs import RunFolder
from phd_exp.training.predictions import predicted, summary, write_parquet

UNCHANGED = ShiftConfig()


class Table(NamedTuple):
    """A table of predictions of test samples.

    Attributes:
        file: of the table.
        data: the samples.
        origin: the metadata, with what the table depends on.
        words: what is printed of it.
        fewer: the key that asks for fewer samples.
        shift: changes of the samples.
    """

    file: Path
    data: DataConfig
    origin: dict[str, str]
    words: str
    fewer: str
    shift: ShiftConfig = UNCHANGED


def record_tables(run: RunFolder, config: RunConfig, render: Render) -> None:
    """Render and predict the samples of all tables that the configuration asks for, unless they are recorded already.

    Raises RunError if another process holds the run or it has no checkpoint, DatasetError if a sample is missing.
    """
    for table in _tables(run, config):
        if not is_recorded(table.file, table.origin):
            if isinstance(table.data, RenderedConfig):
                render(table.data, fewer=table.fewer)
            record(run, config, table.file, build_source(table.data), table.origin, table.shift)
            print(f"{table.file}: {table.words}", flush=True)
    if config.evaluation.eight_views:
        record_eight_views(run, config, build_source(config.data))


def _tables(run: RunFolder, config: RunConfig) -> Iterator[Table]:
    if several := config.several_views:
        views = several.spec.views
        n = several.n_test // views
        scenes = f"{'1 scene' if n == 1 else f'{n} scenes'} seen by {views} cameras each"
        origin = origin_of(run, config, data=several.spec.fingerprint(), scenes=n)
        yield Table(run.views, several, origin, scenes, "evaluation.multiview.scenes=...")
    for (frames, held_out), moving in config.sequences.items():
        cameras = moving.spec.views
        file, n = run.sequence(frames, held_out=held_out), moving.n_test // (frames * cameras)
        origin = origin_of(run, config, data=moving.spec.fingerprint(), sequences=n)
        words = f"{n} sequence{'s' if n > 1 else ''} of {frames} frames{' from two cameras' if cameras > 1 else ''}"
        yield Table(file, moving, origin, words, "evaluation.sequences=[[N,FRAMES]]")
    for name, shift in config.evaluation.shifts.items():
        origin = origin_of_shift(run, config, name)
        data = config.data_of(name)
        yield Table(run.shift(name), data, origin, "recorded", "evaluation.n_shifted=...", shift)


def record(
    folder: RunFolder,
    config: RunConfig,
    file: Path,
    source: Source,
    origin: Mapping[str, str],
    shift: ShiftConfig = UNCHANGED,
) -> None:
    """Predict the test samples of a source, with the changes of a shift, and write them. Raises as `record_tables`.

    Of several views and of sequences, the table also has the pose of each, and the time.
    """
    network = trained_network([folder], [config])
    change = Photometry(**dict[str, Any](**shift.images)).fixed
    with folder.held():
        table = predicted(network, source.samples("test"), config.camera.f_error, shift.f_factor, change)
        known = dict(source.known("test"))
        if isinstance(source, RenderedSource) and max(source.spec.views, source.spec.frames) > 1:
            known |= _poses_and_times(source)
        make_folder(file.parent)
        write_parquet(file, table, known, origin)


def record_eight_views(
    folder: RunFolder, config: RunConfig, source: Source, parts: Sequence[Part] = PARTS[1:]
) -> None:
    """Predict the eight symmetric views of each sample of a run's own source, once; of held-out and test samples.

    The files have the columns of `predictions.parquet`, of the distribution closest to the mixture, and
    `disagreement`. results.json gets the means over test samples, as `eight_views/nll`. Raises as `record_tables`.
    """
    origin = of_camera(config)
    wanted = [part for part in parts if source.count(part) and not is_recorded(folder.eight_views[part], origin)]
    if not wanted:
        return
    network = trained_network([folder], [config], views=8)
    with folder.held():
        for part in wanted:
            table = predicted(network, source.samples(part), config.camera.f_error)
            if part == "test":
                folder.write_results(folder.results() | summary(table, "eight_views"))
            write_parquet(folder.eight_views[part], table, source.known(part), origin)


def record_held_out_views(folder: RunFolder, config: RunConfig, source: Source) -> None:
    """Record the eight views of a finished run's held-out samples. Raises RunError if they are others by now."""
    before, now = read_table(folder.held_out), source.samples("held_out").xyz.double().numpy()
    if not np.array_equal(now, stacked(before, XYZ).numpy()):
        raise RunError(f"{folder.held_out}: its samples are not those of {config.data.name} now; train again")
    file = folder.eight_views["held_out"]
    announce(f"{file}: recording the eight views of {len(now)} held-out samples, once")
    record_eight_views(folder, config, source, ["held_out"])


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

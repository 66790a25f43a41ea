"""What a training records beyond its own test samples: several views, sequences, shifts and turned images."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from phd_exp.build import build_source
from phd_exp.config import FolderConfig, RenderedConfig, RunConfig, SourceConfig
from phd_exp.config.sections import Render, ShiftConfig
from phd_exp.inference import tables
from phd_exp.records.runs import RunFolder


@dataclass(frozen=True)
class Further:
    """A table of predictions of other samples than the run's own.

    Attributes:
        file: the table.
        data: the data set, whose test samples are predicted.
        origin: the choices that made the table.
        content: what it holds, in words.
        fewer: the override for fewer samples.
        shift: a change of the samples.
    """

    file: Path
    data: RenderedConfig | FolderConfig | SourceConfig
    origin: dict[str, str]
    content: str
    fewer: str
    shift: ShiftConfig = tables.UNCHANGED


def record_further(run: RunFolder, config: RunConfig, render: Render) -> None:
    """Render the missing samples of all further tables that a configuration asks for, and record them, once."""
    for one in further(run, config):
        if not tables.is_recorded(one.file, one.origin):
            if isinstance(one.data, RenderedConfig):
                render(one.data, fewer=one.fewer)
            tables.record(run, one.file, build_source(one.data), one.origin, one.shift)
            print(f"{one.file}: {one.content}", flush=True)
    if config.evaluation.eight_views:
        tables.record_eight_views(run, config, build_source(config.data))


def further(run: RunFolder, config: RunConfig) -> Iterator[Further]:
    """The tables of other samples that a configuration asks for."""
    if several := config.several_views:
        views = several.spec.views
        n = several.n_test // views
        content = f"{'1 scene' if n == 1 else f'{n} scenes'} seen by {views} cameras each"
        origin = tables.origin_of(run, config, data=several.spec.fingerprint(), scenes=n)
        yield Further(run.views, several, origin, content, "evaluation.multiview.scenes=...")
    for (frames, held_out), moving in config.sequences.items():
        file, cameras = run.sequence(frames, held_out=held_out), moving.spec.views
        n = moving.n_test // (frames * cameras)
        content = f"{n} sequence{'s' if n > 1 else ''} of {frames} frames{' from two cameras' if cameras > 1 else ''}"
        origin = tables.origin_of(run, config, data=moving.spec.fingerprint(), sequences=n)
        yield Further(file, moving, origin, content, "evaluation.sequences=[[N,FRAMES]]")
    for name, shift in config.evaluation.shifts.items():
        origin, data = tables.origin_of_shift(run, config, name), config.data_of(name)
        yield Further(run.shift(name), data, origin, "recorded", "evaluation.n_shifted=...", shift)

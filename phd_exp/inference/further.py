"""Predictions of further samples after a training: several views, sequences, shifts and eight symmetric views."""

from pathlib import Path

from phd_exp.build import build_source
from phd_exp.config import RenderedConfig, RunConfig
from phd_exp.config.sections import DataConfig, Render, ShiftConfig
from phd_exp.inference.tables import UNCHANGED, is_recorded, origin_of, origin_of_shift, record, record_eight_views
from phd_exp.records.runs import RunFolder


def record_further(run: RunFolder, config: RunConfig, render: Render) -> None:
    """Render and predict the further samples that the configuration asks for, unless they are recorded already."""

    def once(
        file: Path, data: DataConfig, origin: dict[str, str], words: str, fewer: str, shift: ShiftConfig = UNCHANGED
    ) -> None:
        if not is_recorded(file, origin):
            if isinstance(data, RenderedConfig):
                render(data, fewer=fewer)
            record(run, file, build_source(data), origin, shift)
            print(f"{file}: {words}", flush=True)

    if several := config.several_views:
        views = several.spec.views
        n = several.n_test // views
        scenes = f"{'1 scene' if n == 1 else f'{n} scenes'} seen by {views} cameras each"
        origin = origin_of(run, config, data=several.spec.fingerprint(), scenes=n)
        once(run.views, several, origin, scenes, "evaluation.multiview.scenes=...")
    for (frames, held_out), moving in config.sequences.items():
        cameras = moving.spec.views
        file, n = run.sequence(frames, held_out=held_out), moving.n_test // (frames * cameras)
        origin = origin_of(run, config, data=moving.spec.fingerprint(), sequences=n)
        words = f"{n} sequence{'s' if n > 1 else ''} of {frames} frames{' from two cameras' if cameras > 1 else ''}"
        once(file, moving, origin, words, "evaluation.sequences=[[N,FRAMES]]")
    for name, shift in config.evaluation.shifts.items():
        origin = origin_of_shift(run, config, name)
        once(run.shift(name), config.data_of(name), origin, "recorded", "evaluation.n_shifted=...", shift)
    if config.evaluation.eight_views:
        record_eight_views(run, config, build_source(config.data))
